/* The body of a kernel that FFCx has written for one cell, run on as many at once as fit into the processor's
   registers (cross-element vectorization: Sun, Mitchell, Kulkarni, Kloeckner, Ham and Kelly 2020). Each of its
   variables holds one number of each cell. `kernels/cell_batches.py` writes it into the file KERNEL with these
   names, and COORDINATES, COEFFICIENTS and ENTRIES are what it has of one cell; BLOCK entries are of one node. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined __AVX512F__
#define LANES 8
#elif defined __AVX__
#define LANES 4
#else
#define LANES 2
#endif

typedef double Real __attribute__((vector_size(8 * LANES)));
typedef int64_t Mask __attribute__((vector_size(8 * LANES)));

#define INLINE static inline __attribute__((always_inline))
#define ZERO ((Real){0})
/* A number in all lanes; x - 0 is x, whatever its sign. */
#define EACH(x) ((x) - ZERO)

INLINE Real choose(Mask yes, Real a, Real b) { return (Real)((yes & (Mask)a) | (~yes & (Mask)b)); }
#define SELECT(yes, a, b) choose(yes, EACH(a), EACH(b))

/* ---- functions of numbers, lane after lane but for those that materials have most */
#define LANEWISE(name)                  \
    INLINE Real each_##name(Real x)     \
    {                                   \
        double a[LANES];                \
        memcpy(a, &x, sizeof a);        \
        for (int i = 0; i < LANES; i++) \
            a[i] = name(a[i]);          \
        memcpy(&x, a, sizeof a);        \
        return x;                       \
    }

LANEWISE(sqrt)
LANEWISE(sin)
LANEWISE(cos)
LANEWISE(tan)
LANEWISE(sinh)
LANEWISE(cosh)
LANEWISE(tanh)
LANEWISE(asin)
LANEWISE(acos)
LANEWISE(atan)
LANEWISE(erf)

#define LANEWISE_OF_TWO(name)               \
    INLINE Real each_##name(Real x, Real y) \
    {                                       \
        double a[LANES], b[LANES];          \
        memcpy(a, &x, sizeof a);            \
        memcpy(b, &y, sizeof b);            \
        for (int i = 0; i < LANES; i++)     \
            a[i] = name(a[i], b[i]);        \
        memcpy(&x, a, sizeof a);            \
        return x;                           \
    }

LANEWISE_OF_TWO(fmin)
LANEWISE_OF_TWO(fmax)
LANEWISE_OF_TWO(atan2)
LANEWISE_OF_TWO(pow)

INLINE Real each_fabs(Real x) { return (Real)((Mask)x & INT64_MAX); }

/* The logarithm as in FDLIBM (Sun Microsystems 1993), whose error is below one unit in the last place:
   x = 2^k (1 + f), log(1 + f) = f - f^2/2 + s (f^2/2 + R(s^2)), s = f / (2 + f). */
INLINE Real each_log(Real x)
{
    const Mask tiny = x < 0x1p-1022;
    const Mask bits = (Mask)choose(tiny, x * 0x1p54, x);
    const Mask power = (bits - INT64_C(0x3fe6a09e667f3bcd)) >> 52; /* of two, with 1 + f from sqrt(1/2) to sqrt(2) */
    const Real k = __builtin_convertvector(power, Real) - choose(tiny, EACH(54.0), ZERO);
    const Real f = (Real)(bits - (power << 52)) - 1.0;
    const Real half = 0.5 * f * f, s = f / (2.0 + f), z = s * s, w = z * z;
    const Real even = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01));
    const Real odd = z * (6.666666666666735130e-01
                          + w * (2.857142874366239149e-01 + w * (1.818357216161805012e-01 + w * 1.479819860510658591e-01)));
    const Real y = k * 6.93147180369123816490e-01
                   - ((half - (s * (half + (even + odd)) + k * 1.90821492927058770002e-10)) - f);
    const Real outside = choose(x < 0.0, EACH(NAN), choose(x == 0.0, EACH(-INFINITY), x)); /* inf and NaN stay */
    return choose((x > 0.0) & (x < INFINITY), y, outside);
}

/* The exponential as in FDLIBM (Sun Microsystems 2004), whose error is below one unit in the last place:
   x = k ln 2 + r, exp(r) = 1 + r + r c / (2 - c) with c = r - r^2 P(r^2); 2^k in two parts, as small numbers need. */
INLINE Real each_exp(Real x)
{
    const Real near = choose(x > 720.0, EACH(720.0), choose(x < -750.0, EACH(-750.0), x)); /* NaN stays */
    const Real shift = EACH(0x1.8p52); /* what is added to it is rounded to a whole number */
    const Real whole = (near * 1.44269504088896338700e+00 + shift) - shift;
    const Mask k = __builtin_convertvector(choose(whole == whole, whole, ZERO), Mask);
    const Real high = near - whole * 6.93147180369123816490e-01, low = whole * 1.90821492927058770002e-10;
    const Real r = high - low, t = r * r;
    const Real even = t * (1.66666666666666019037e-01
                           + t * (-2.77777777770155933842e-03
                                  + t * (6.61375632143793436117e-05
                                         + t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08))));
    const Real c = r - even;
    const Real y = 1.0 - ((low - r * c / (2.0 - c)) - high);
    const Mask half = k >> 1;
    return y * (Real)((half + 1023) << 52) * (Real)((k - half + 1023) << 52);
}

INLINE Real power_of_whole(Real x, int n)
{
    const int times = n < 0 ? -n : n;
    if (times == 0 || times > 4)
        return each_pow(x, EACH((double)n));
    Real y = x;
    for (int i = 1; i < times; i++)
        y *= x;
    return n < 0 ? 1.0 / y : y;
}

INLINE Real power_of_real(Real x, double y)
{
    if (y == 0.5)
        return each_sqrt(x);
    return y == (int)y ? power_of_whole(x, (int)y) : each_pow(x, EACH(y));
}

#define sqrt(x) each_sqrt(EACH(x))
#define exp(x) each_exp(EACH(x))
#define sin(x) each_sin(EACH(x))
#define cos(x) each_cos(EACH(x))
#define tan(x) each_tan(EACH(x))
#define sinh(x) each_sinh(EACH(x))
#define cosh(x) each_cosh(EACH(x))
#define tanh(x) each_tanh(EACH(x))
#define asin(x) each_asin(EACH(x))
#define acos(x) each_acos(EACH(x))
#define atan(x) each_atan(EACH(x))
#define erf(x) each_erf(EACH(x))
#define fmin(x, y) each_fmin(EACH(x), EACH(y))
#define fmax(x, y) each_fmax(EACH(x), EACH(y))
#define atan2(x, y) each_atan2(EACH(x), EACH(y))
#define fabs(x) each_fabs(EACH(x))
#define log(x) each_log(EACH(x))
#define pow(x, y) _Generic((y), int : power_of_whole, double : power_of_real, default : each_pow)(EACH(x), y)

INLINE void kernel(Real *restrict A, const Real *restrict w, const double *restrict c,
                   const Real *restrict coordinate_dofs)
{
#include KERNEL
}

/* Values of a Function, of which dofs [cells][blocks] are those of the cells; each has `size` numbers. */
typedef struct {
    const double *values;
    const int32_t *dofs;
    int blocks, size;
} Field;

/* Adds what the cells contribute to `out`.

   nodes [cells][COORDINATES / 3] and dofs [cells][ENTRIES / BLOCK]: numbers of nodes with coordinates x [3] and of
   blocks of `out`; fields: of the form, with COEFFICIENTS numbers in a cell; c: constants. */
void assemble(long cells, const int32_t *nodes, const double *x, const int32_t *dofs, int fields, const Field *field,
              const double *c, double *out)
{
    enum { NODES = COORDINATES / 3, BLOCKS = ENTRIES / BLOCK };
    for (long first = 0; first < cells; first += LANES) {
        Real A[ENTRIES], coefficients[COEFFICIENTS + 1], coordinate_dofs[COORDINATES];
        const int here = cells - first < LANES ? cells - first : LANES;
        memset(A, 0, sizeof A);
        for (int lane = 0; lane < LANES; lane++) {
            const long cell = lane < here ? first + lane : first; /* lanes without a cell repeat one */
            for (int i = 0; i < NODES; i++)
                for (int k = 0; k < 3; k++)
                    coordinate_dofs[3 * i + k][lane] = x[3 * nodes[cell * NODES + i] + k];
            Real *next = coefficients;
            for (int f = 0; f < fields; f++) {
                const int blocks = field[f].blocks, size = field[f].size;
                for (int i = 0; i < blocks; i++)
                    for (int k = 0; k < size; k++)
                        (*next++)[lane] = field[f].values[size * field[f].dofs[cell * blocks + i] + k];
            }
        }
        kernel(A, coefficients, c, coordinate_dofs);
        for (int lane = 0; lane < here; lane++)
            for (int i = 0; i < BLOCKS; i++)
                for (int k = 0; k < BLOCK; k++)
                    out[BLOCK * dofs[(first + lane) * BLOCKS + i] + k] += A[BLOCK * i + k][lane];
    }
}
