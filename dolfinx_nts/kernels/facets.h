/* What the compiled kernels share: facets of all kinds are polynomials, whose coefficients come from
   kernels/compiled.py. */

#include <math.h>
#include <string.h>

enum { CONTROL = 16, DEGREE = 4 };

/* Loops of a length that is known when this is compiled take half the time: what has it as an argument is
   compiled where that is a number. */
#define INLINE static inline __attribute__((always_inline))

/* nc control points; polynomials of this degree in each coordinate, or in both together on triangles;
   coefficients [order][derivatives by the second coordinate][power of the first][power of the
   second][control point]. */
typedef struct {
    int nc, degree, together;
    const double *coefficients;
} Facet;

/* Derivatives of the shape functions: [order][how many by the second coordinate][control point]. */
typedef double Shape[4][4][CONTROL];

/* The shape functions and their derivatives up to an order. */
void shape(const Facet *facet, const double *xi, int highest, Shape n);

/* fmin and fmax, which care for NaN, are calls. */
static inline double smaller(double a, double b) { return a < b ? a : b; }
static inline double larger(double a, double b) { return a > b ? a : b; }

static inline double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* sum n_i v_i */
static inline void combine(int nc, const double *restrict n, const double (*restrict v)[3], double *restrict out)
{
    out[0] = out[1] = out[2] = 0.0;
    for (int i = 0; i < nc; i++)
        for (int k = 0; k < 3; k++)
            out[k] += n[i] * v[i][k];
}

/* sum a_i b_i */
static inline double sum(int nc, const double *a, const double *b)
{
    double total = 0.0;
    for (int i = 0; i < nc; i++)
        total += a[i] * b[i];
    return total;
}
