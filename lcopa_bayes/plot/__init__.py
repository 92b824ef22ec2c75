"""Figures of results: each function takes a result and returns a matplotlib figure, as the pages draw it."""

from lcopa_bayes.plot.figures import bands as bands
from lcopa_bayes.plot.figures import before_after as before_after
from lcopa_bayes.plot.figures import bode as bode
from lcopa_bayes.plot.figures import corner as corner
from lcopa_bayes.plot.figures import design as design
from lcopa_bayes.plot.figures import director as director
from lcopa_bayes.plot.figures import drive as drive
from lcopa_bayes.plot.figures import evidence as evidence
from lcopa_bayes.plot.figures import far_field as far_field
from lcopa_bayes.plot.figures import fleet as fleet
from lcopa_bayes.plot.figures import forest as forest
from lcopa_bayes.plot.figures import prediction as prediction
from lcopa_bayes.plot.figures import profiles as profiles
from lcopa_bayes.plot.figures import residuals as residuals
from lcopa_bayes.plot.figures import steps as steps
