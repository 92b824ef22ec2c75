"""What numbers of double precision do not resolve is refused, with the records that make it so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import TRUTH, problem, record, row_values

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.precision import LEAST, refuse_unresolved

SIGMA = 1e-9


def posterior(scale: float) -> Posterior:
    """Of two records, the response of one of them in units `scale` times as small, under noise of 1e-9."""
    one, other = record(1, name="one"), record(2, name="other")
    return problem(one, replace(other, response=other.response * scale), priors={"sigma": SIGMA}).posterior


def truth(own: Posterior) -> Vector:
    """Table values of the truth under the noise that is stated."""
    offsets = {name: TRUTH["offset"] for name in own.table.names if name.startswith("offset")}
    return row_values(own.table, TRUTH | offsets | {"sigma": SIGMA})


def test_a_record_in_other_units_is_named_with_both_ranges():
    with pytest.raises(InputError, match="same units") as refused:
        find_optima(posterior(1e6), np.random.default_rng(0), starts=2)
    said = str(refused.value)
    assert "in record 'one' and" in said
    assert said.split(" in record 'one'")[1].count("'other'") == 1


def test_the_distance_is_that_of_the_residual():
    """Records that agree, of noise TRUTH["sigma"] where 1e-9 is stated."""
    own = posterior(1.0)
    with pytest.raises(InputError) as refused:
        refuse_unresolved(own, truth(own), 1.01 * LEAST)
    distance = float(str(refused.value).split("about ")[1].split(" times")[0])
    assert distance == pytest.approx(TRUTH["sigma"] / SIGMA, rel=0.2)


def test_the_record_that_is_followed_least_is_named():
    own = posterior(1e6)
    with pytest.raises(InputError, match=r"^record 'other': response 'y' is about "):
        refuse_unresolved(own, truth(own), 1.01 * LEAST)


def test_from_the_limit_on_nothing_is_refused():
    own = posterior(1.0)
    refuse_unresolved(own, truth(own), LEAST)


def test_the_limit_is_where_a_tenth_of_a_nat_is_lost():
    assert np.spacing(-LEAST) == pytest.approx(0.1, rel=0.5)
