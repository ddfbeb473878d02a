/* A pair of a point and a facet: what the kernels of nts_element.c and surface_points.c share. */

#include "facets.h"

/* Gauss points: as many as kernels/nts_element.py, GAUSS_POINTS, has at most. */
enum { WIDTH = 3 * CONTROL, SUMS = 6, MOST_POINTS = 6 };

typedef struct {
    Facet facet;
    int points, tangential;
    const double *tau, *weight;
} Rule;

/* A pair at t_n and t_{n+1}: y_I = x_I - x_s, d, f, with d at t_{n+1} found from f. */
typedef struct {
    double y[2][CONTROL][3], d[2][3], f[2][2];
} Place;

/* Its derivatives by the y_I: of x_s, whose sums are with them zero, they are minus their sums. */
typedef struct {
    /* Force, its columns by lambda_N and by lambda_T over the facet's size, and by y. */
    double force[WIDTH], by_normal[WIDTH], by_slip[2][WIDTH], stiffness[WIDTH][WIDTH];
    /* Gap, shape functions at its foot, and the gradient of f. */
    double gap, n[CONTROL], foot[2][WIDTH];
} Pair;

/* y, its two tangents and three bends where f is; and in the middle of both ends. */
typedef double Sums[SUMS][3];

void place_of(int nc, const double *x0, const double *x1, const double *d0, const double *f0, const double *f1, Place *p);

/* Force and stiffness of a pair whose d[1] is not yet known; t is lambda_T times the facet's size. */
void pair_of(const Rule *rule, Place *p, double normal, const double *t, Pair *out);

INLINE void sums(int nc, const Shape n, const double (*y)[3], Sums out)
{
    combine(nc, n[0][0], y, out[0]);
    for (int order = 1, k = 1; order < 3; order++)
        for (int b = 0; b <= order; b++, k++)
            combine(nc, n[order][b], y, out[k]);
}

/* out += factor v_I u */
INLINE void outer(int nc, double factor, const double *restrict v, const double *restrict u, double *restrict out)
{
    for (int i = 0; i < nc; i++)
        for (int k = 0; k < 3; k++)
            out[3 * i + k] += factor * v[i] * u[k];
}

INLINE void axpy(int size, double factor, const double *restrict a, double *restrict out)
{
    for (int i = 0; i < size; i++)
        out[i] += factor * a[i];
}
