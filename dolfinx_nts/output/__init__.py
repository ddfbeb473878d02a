"""Writers of fields, tables and films, plots and pictures."""

from dolfinx_nts.output.film import Film
from dolfinx_nts.output.writers import BalanceCSV, Fields, ForcesCSV

__all__ = ["BalanceCSV", "Fields", "Film", "ForcesCSV"]
