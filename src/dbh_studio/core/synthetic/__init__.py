"""Forest plots made by the program itself, with known truth: for the demo, the tests and the benchmarks."""

from dbh_studio.core.synthetic.plot import make_plot
from dbh_studio.core.synthetic.recipe import GENERATOR_VERSION, PlotRecipe, SyntheticPlot, TreeTruth

__all__ = ["GENERATOR_VERSION", "PlotRecipe", "SyntheticPlot", "TreeTruth", "make_plot"]
