"""Forms in UFL that do not show when their terminals were made: equal ones are compiled once.

What DOLFINx keeps compiled is found by the form's signature. UFL orders sums and products with
Constants by their counts as text, so that 9 and 10 make another form than 10 and 11, and writes the
counts of free indices into zeros. Counts go on with all that a script has made before, or that a
compiler has, and so the second run of a script compiles forms again.
"""

from __future__ import annotations

from typing import Any

import ufl
from ufl.algorithms.analysis import extract_coefficients
from ufl.algorithms.map_integrands import map_integrand_dags
from ufl.classes import Zero
from ufl.core.multiindex import FixedIndex, Index, MultiIndex
from ufl.corealg.multifunction import MultiFunction
from ufl.corealg.traversal import traverse_unique_terminals

#: Count of the first Constant that stands for another; a form has fewer than 900.
_FIRST = 100


def canonical(form: Any) -> Any:
    """A form whose signature does not depend on what was made before it.

    Returns:
        The form itself, or one with the same integrals of Constants and Functions that stand for
        the given ones, with their `_cpp_object`, which is all that DOLFINx asks of them.
    """
    constants = form.constants()
    if len({len(str(c.count())) for c in constants}) <= 1 and not _has_indexed_zeros(form):
        return form
    stands = {}
    for k, given in enumerate(extract_coefficients(form)):
        stands[given] = ufl.Coefficient(given.ufl_function_space(), count=k)
    for k, given in enumerate(constants, start=_FIRST):
        stands[given] = ufl.Constant(given.ufl_domain(), given.ufl_shape, count=k)
    for given, stand in stands.items():
        if hasattr(given, "_cpp_object"):
            stand._cpp_object = given._cpp_object
    return map_integrand_dags(_Renumber(stands), form)


def _has_indexed_zeros(form: Any) -> bool:
    return any(
        isinstance(t, Zero) and t.ufl_free_indices
        for part in form.integrals()
        for t in traverse_unique_terminals(part.integrand())
    )


class _Renumber(MultiFunction):  # type: ignore[misc]
    """Replaces terminals; sums and products that hold them are ordered anew.

    Args:
        stands: Coefficients and Constants by what they stand for.
    """

    def __init__(self, stands: dict[Any, Any]) -> None:
        super().__init__()
        self._stands = stands
        self._indices: dict[int, int] = {}

    expr = MultiFunction.reuse_if_untouched

    def coefficient(self, o: Any) -> Any:
        """What stands for a Function."""
        return self._stands[o]

    def constant(self, o: Any) -> Any:
        """What stands for a Constant."""
        return self._stands[o]

    def multi_index(self, o: Any) -> Any:
        """Its free indices, numbered as they are met."""
        if all(isinstance(i, FixedIndex) for i in o.indices()):
            return o
        return MultiIndex(
            tuple(
                i if isinstance(i, FixedIndex) else Index(count=self._number(i.count()))
                for i in o.indices()
            )
        )

    def zero(self, o: Any) -> Any:
        """A zero with the numbers of its free indices, ascending."""
        if not o.ufl_free_indices:
            return o
        numbers = map(self._number, o.ufl_free_indices)
        free, sizes = zip(*sorted(zip(numbers, o.ufl_index_dimensions, strict=True)), strict=True)
        return Zero(o.ufl_shape, free, sizes)

    def _number(self, count: int) -> int:
        return self._indices.setdefault(count, len(self._indices))
