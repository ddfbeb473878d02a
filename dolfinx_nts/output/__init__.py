"""Writers of fields, tables and films, plots and pictures."""

from dolfinx_nts.output.fields import Fields
from dolfinx_nts.output.film import Film
from dolfinx_nts.output.motions import Motions
from dolfinx_nts.output.tables import BalanceCSV, ForcesCSV

__all__ = ["BalanceCSV", "Fields", "Film", "ForcesCSV", "Motions"]
