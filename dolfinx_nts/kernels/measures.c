/* Discrete gradients of measures, see `measures.py`, and what forces along them contribute; element by element. */
#include <math.h>

/* Half a turn below which x/sin x is differentiated by its series. */
#define SMALL_TURN 1e-3

/* (r_a + r_b)/(l_a + l_b) of the length of one vector. */
static void length(const double *a, const double *b, double at_a, double at_b, double *mean, double *change, double *end)
{
    for (int i = 0; i < 3; i++) {
        mean[i] = (a[i] + b[i]) / (at_a + at_b);
        end[i] = b[i] / at_b;
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            change[3 * i + j] = ((i == j) - mean[i] * end[j]) / (at_a + at_b);
}

/* The product of two vectors, one after the other: that in the middle, as it is quadratic. */
static void along(const double *a, const double *b, double *mean, double *change, double *end)
{
    for (int i = 0; i < 6; i++) {
        int other = (i + 3) % 6;
        mean[i] = 0.5 * (a[other] + b[other]);
        end[i] = b[other];
        for (int j = 0; j < 6; j++)
            change[6 * i + j] = j == other ? 0.5 : 0.0;
    }
}

/* The angle of z = (m_1 . m, m_2 . m) by z, along the circle at half the turn: half the turn over its sine and over the mean
 * of rho, as z_b - z_a has this component there. */
static void on_circle(const double *a, const double *b, double at_a, double at_b, double *mean, double (*change)[2], double *end)
{
    double half = 0.5 * (at_b - at_a), middle = 0.5 * (at_a + at_b), size = hypot(b[0], b[1]);
    double both = 0.5 * (hypot(a[0], a[1]) + size), factor = (half == 0.0 ? 1.0 : half / sin(half)) / both;
    double turn = fabs(half) < SMALL_TURN ? half / 3.0 + half * half * half / 45.0 : 1.0 / half - 1.0 / tan(half);
    double out[2] = {cos(middle), sin(middle)}, radial[2] = {b[0] / size, b[1] / size};
    mean[0] = -factor * out[1], mean[1] = factor * out[0];
    end[0] = -radial[1] / size, end[1] = radial[0] / size;
    for (int k = 0; k < 2; k++)
        for (int l = 0; l < 2; l++)
            change[k][l] = 0.5 * (turn * mean[k] - factor * out[k]) * end[l] - 0.5 / both * mean[k] * radial[l];
}

/* The same by m_1, m_2 and m, with the gradient of z in the middle: z is quadratic. */
static void angle(const double *a, const double *b, double at_a, double at_b, double *mean, double *change, double *end)
{
    double z[2][2] = {{0.0}}, middle[2][9] = {{0.0}}, last[2][9] = {{0.0}}, by_z[2], bent[2][2], at_end[2];
    for (int k = 0; k < 2; k++)
        for (int i = 0; i < 3; i++) {
            z[0][k] += a[3 * k + i] * a[6 + i];
            z[1][k] += b[3 * k + i] * b[6 + i];
            last[k][3 * k + i] = b[6 + i];
            last[k][6 + i] = b[3 * k + i];
            middle[k][3 * k + i] = 0.5 * (a[6 + i] + b[6 + i]);
            middle[k][6 + i] = 0.5 * (a[3 * k + i] + b[3 * k + i]);
        }
    on_circle(z[0], z[1], at_a, at_b, by_z, bent, at_end);
    for (int i = 0; i < 9; i++) {
        mean[i] = by_z[0] * middle[0][i] + by_z[1] * middle[1][i];
        end[i] = at_end[0] * last[0][i] + at_end[1] * last[1][i];
        for (int j = 0; j < 9; j++) {
            change[9 * i + j] = 0.0;
            for (int k = 0; k < 2; k++)
                change[9 * i + j] += middle[k][i] * (bent[k][0] * last[0][j] + bent[k][1] * last[1][j]);
        }
    }
    for (int k = 0; k < 2; k++)
        for (int i = 0; i < 3; i++) {
            change[9 * (3 * k + i) + 6 + i] += 0.5 * by_z[k];
            change[9 * (6 + i) + 3 * k + i] += 0.5 * by_z[k];
        }
}

/* Discrete gradients of n measures of v vectors: lengths (v = 1), ways (2), angles (3), between the ends a and b. */
void gradients(int v, long n, const double *a, const double *b, const double *at_a, const double *at_b, double *mean,
               double *change, double *end)
{
    int size = 3 * v;
    for (long e = 0; e < n; e++, a += size, b += size, mean += size, end += size, change += size * size) {
        if (v == 1)
            length(a, b, at_a[e], at_b[e], mean, change, end);
        else if (v == 2)
            along(a, b, mean, change, end);
        else
            angle(a, b, at_a[e], at_b[e], mean, change, end);
    }
}

/* Residual, tangent and work of n measures of v vectors of k nodes, v at most 3; what they are written to holds zeros.
 *   held: whether there is a multiplier, in the last row and column; else what is of it is not read
 *   share, factor: see `Move`, `Step`; weights: of the nodes in the vectors
 *   mean, change, ends: discrete gradient, its derivative, and the gradient at t_{n+1}
 *   pull, slopes: the force and its derivative by the vectors; units: force per unit of the multiplier
 *   rows, by_end, by_force: value and derivatives of the multiplier's equation, in the units of the step
 *   moved: of the nodes */
void forces_along(int k, int v, int held, double share, double factor, long n, const double *weights, const double *mean,
                  const double *change, const double *ends, const double *pull, const double *slopes, const double *units,
                  const double *rows, const double *by_end, const double *by_force, const double *moved, double *residuals,
                  double *tangents, double *works)
{
    int s = 3 * v, last = 3 * k, size = last + (held ? 1 : 0);
    for (long e = 0; e < n; e++, weights += v * k, mean += s, ends += s, slopes += s, change += s * s, moved += last,
              residuals += size, tangents += (long)size * size) {
        for (int a = 0; a < k; a++)
            for (int i = 0; i < 3; i++) {
                double half[9] = {0.0}, to_node = 0.0, to_end = 0.0, *tangent = tangents + (long)(3 * a + i) * size;
                for (int w = 0; w < v; w++) {
                    double weight = weights[w * k + a], own = mean[3 * w + i];
                    if (weight == 0.0)
                        continue;
                    to_node += weight * own;
                    if (held)
                        to_end += weight * ends[3 * w + i];
                    for (int j = 0; j < s; j++)
                        half[j] += weight * (share * pull[e] * change[(3 * w + i) * s + j] + own * slopes[j]);
                }
                for (int w = 0; w < v; w++)
                    for (int b = 0; b < k; b++) {
                        double weight = factor * weights[w * k + b];
                        for (int j = 0; weight != 0.0 && j < 3; j++)
                            tangent[3 * b + j] += weight * half[3 * w + j];
                    }
                residuals[3 * a + i] = factor * pull[e] * to_node;
                works[e] += pull[e] * to_node * moved[3 * a + i];
                if (held) {
                    tangent[last] = units[e] * to_node;
                    tangents[(long)last * size + 3 * a + i] = by_end[e] * to_end;
                }
            }
        if (held) {
            residuals[last] = rows[e];
            tangents[(long)last * size + last] = by_force[e];
        }
    }
}
