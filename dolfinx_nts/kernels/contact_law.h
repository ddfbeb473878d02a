/* What the laws of contact and friction are told of pairs, and the smooth laws that lead to them. */

#include "facets.h"

/* What the pairs have in common, and what each has of its own in a step; `before` is NULL without
   massless nodes, `unmoved` where nothing is prescribed; `coefficients`, with their derivatives by the distance of
   the slip and by the force that presses, are NULL where all pairs have the same constant coefficient. */
typedef struct {
    const double *scale, *yielding, *none, *before;
    int size, row, friction, endless, strong, redundant;
    double coefficient, pull, uneven, opening, hardly, width, gap_width;
    const double *tangential_scale, *unmoved, *coefficients, *by_slip, *by_force;
} Law;

typedef struct {
    double force, normal, tangential;
} Together;

/* Slip [2], metric [2][2] and their gradients [2][size] and [2][2][size]. */
typedef struct {
    const double *value, *gradient, *metric, *metric_gradient;
} Slip;

/* Contravariant components of covariant ones. */
static inline void raise(const double *m, const double *t, double *out)
{
    double determinant = m[0] * m[3] - m[1] * m[1];
    out[0] = (m[3] * t[0] - m[1] * t[1]) / determinant;
    out[1] = (m[0] * t[1] - m[1] * t[0]) / determinant;
}

static inline double length(const double *m, const double *t)
{
    double up[2];
    raise(m, t, up);
    return sqrt(t[0] * up[0] + t[1] * up[1]);
}

static inline double distance_of(const Slip *slip)
{
    const double *m = slip->metric, *s = slip->value;
    return sqrt(s[0] * (m[0] * s[0] + m[1] * s[1]) + s[1] * (m[2] * s[0] + m[3] * s[1]));
}

static inline int any(const double *a) { return a && (a[0] != 0.0 || a[1] != 0.0 || a[2] != 0.0 || a[3] != 0.0); }

/* ---- blurred laws */

/* What presses a pair [kg m], and its derivatives by the multiplier of the gap and by the gap. */
typedef struct {
    double force, by_multiplier, by_gap;
} Press;

/* The row of the gap by a smooth law, which tends to that of contact with its width: with the force a and b = c g_N
   both are positive and a b = (c width)^2, as the root of a = (a - b + R)/2, R^2 = (a - b)^2 + 4 (c width)^2 (Chen and
   Harker 1993, Kanzow 1996). Returned is whether the force outweighs the gap. */
static inline int blur_gap(const Law *law, double force, double of_end, double c, double *residual, double *tangent,
                    Press *press)
{
    int row = law->row;
    double square = c * c * law->gap_width * law->gap_width, a = -force, b = c * residual[row];
    double root = sqrt((a - b) * (a - b) + 4.0 * square), on = 0.5 * (1.0 + (a - b) / root);
    double *by_gap = tangent + row * law->size;
    press->force = a > b ? 0.5 * (a - b + root) : 2.0 * square / (b - a + root);
    press->by_multiplier = -on * of_end;
    press->by_gap = -c;
    residual[row] = (a - press->force) / c;
    for (int z = 0; z < law->size; z++)
        by_gap[z] *= on;
    by_gap[row] -= (1.0 - on) * of_end / c;
    return a > b;
}

/* The rows of lambda_T by a smooth law: times the root of s m s + width^2 it is the bound times m s. In the slope of
   that lambda_T stands for the bound along the slip, as long as it is within it (Chan, Golub and Mulet 1999).
   Returned is whether the slip is below the width. */
static inline int blur_slip(const Law *law, double mu, const Slip *slip, const double *end, double of_end, double scale,
                     const Press *press, double *residual, double *tangent)
{
    int size = law->size, gap = law->row, last = size - 2;
    const double *t = end + (size - gap) - 2, *m = slip->metric, *s = slip->value, *by_gap = tangent + gap * size;
    double low[2] = {m[0] * s[0] + m[1] * s[1], m[2] * s[0] + m[3] * s[1]}, width = law->width;
    double square = s[0] * low[0] + s[1] * low[1], far = sqrt(square + width * width), bound = mu * press->force;
    double friction = length(m, t), part = friction > bound ? bound / friction : 1.0;
    for (int i = 0; i < 2; i++) {
        double *row = tangent + (last + i) * size, unit = low[i] / far, by_slip[2], by_metric[2][2];
        residual[last + i] = (t[i] - bound * unit) / scale;
        for (int j = 0; j < 2; j++) {
            by_slip[j] = (part * t[i] * low[j] / far - bound * m[2 * i + j]) / far;
            for (int k = 0; k < 2; k++)
                by_metric[j][k] = (0.5 * part * t[i] * s[j] * s[k] / far - (i == j) * bound * s[k]) / far;
        }
        for (int z = 0; z < size; z++) {
            row[z] = z < gap ? -mu * unit * press->by_gap * by_gap[z] : 0.0;
            for (int j = 0; j < 2; j++) {
                row[z] += by_slip[j] * slip->gradient[j * size + z];
                for (int k = 0; k < 2; k++)
                    row[z] += by_metric[j][k] * slip->metric_gradient[(2 * j + k) * size + z];
            }
            row[z] /= scale;
        }
        row[gap] -= mu * unit * press->by_multiplier / scale;
        row[last + i] += of_end / scale;
    }
    return square <= width * width;
}
