"""A block on a slope: benchmark B5, and the verge of slipping."""

import numpy as np
import slope as demo


def test_closed_forms_are_the_benchmarks():
    """Figures of B5, computed elsewhere."""
    values = list(demo.CLOSED_FORM.values())
    np.testing.assert_allclose(values[:2], [1.178144, 3.00275], atol=6e-7)
