"""Cases in which each value of one parameter meets each value of every other, and no more."""

import itertools


def pairs(*values):
    """All pairs of values in few cases, as rows for `parametrize`.

    Faults depend on one parameter or on two together, hardly ever on three: where a product has
    cases for each triple, this has about as many as the two longest lists have pairs.

    Args:
        values: Those of each parameter; none of them twice.

    Returns:
        Tuples, the same in each run.
    """
    every = list(itertools.product(*(range(len(v)) for v in values)))

    def met(case):
        return set(itertools.combinations(enumerate(case), 2))

    missing, cases = set().union(*map(met, every)), []
    while missing:
        cases.append(max(every, key=lambda case: len(met(case) & missing)))
        missing -= met(cases[-1])
    lists = [list(v) for v in values]
    return [tuple(v[k] for v, k in zip(lists, case, strict=True)) for case in sorted(cases)]
