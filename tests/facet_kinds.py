"""The kinds of facets by their number of control points, flat ones of each, and points on them."""

import numpy as np

#: Triangle, quadrilateral, patch over a quadrilateral and over a triangle.
KINDS = (3, 4, 16, 15)
#: Corners of the quadrilateral, then the points beyond them that its patch needs.
RING = np.array(
    [
        *[(0, 0), (1, 0), (1, 1), (0, 1)],
        *[(-1, 0), (1, -1), (2, 1), (0, 2)],
        *[(0, -1), (2, 0), (1, 2), (-1, 1)],
        *[(-1, -1), (2, -1), (2, 2), (-1, 2)],
    ]
)
#: Powers of the corners' coordinates in the control points of degree 4 over a triangle.
POWERS = np.array(
    [
        *[(4, 0, 0), (0, 4, 0), (0, 0, 4)],
        *[(3, 1, 0), (3, 0, 1), (2, 2, 0), (2, 1, 1), (2, 0, 2), (1, 3, 0), (1, 2, 1), (1, 1, 2)],
        *[(1, 0, 3), (0, 3, 1), (0, 2, 2), (0, 1, 3)],
    ]
)
#: Control points of a flat facet, shape (nc, 3).
FLAT = {
    3: np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
    4: np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
    16: np.column_stack([RING, np.zeros(16)]),
    15: np.column_stack([POWERS[:, 1:] / 4, np.zeros(15)]),
}
#: Local coordinates near the middle of the facet.
CENTRE = {3: np.array([0.3, 0.4]), 4: np.array([0.2, -0.3])}
CENTRE |= {16: CENTRE[4], 15: CENTRE[3]}
#: Points along the edge of a quadrilateral in its local coordinates.
LINE = np.linspace(-1.0, 1.0, 9)
