"""The answers that stand first on the page of a fit."""

from __future__ import annotations

from markupsafe import Markup

from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section

_LINK = Markup(' <a href="#{anchor}">{title}</a>')
_ANSWER = Markup("<strong>{question}</strong> {answer}{link}")


def overview(run: SavedRun) -> Section:
    """The plant of highest density, and one sentence for each question a reader has."""
    values = run.results["overview"]
    answers = tuple(
        _ANSWER.format(
            question=one["question"],
            answer=one["answer"],
            link=_LINK.format(anchor=Section(one["section"]).anchor, title=one["section"])
            if one["section"]
            else "",
        )
        for one in values["answers"]
    )
    unit = f"At the draw of highest density; s in 1/{run.time_unit}, times and delays in {run.time_unit}."
    return Section("Summary", answers, listing="\n".join([*values["plant"], unit]))
