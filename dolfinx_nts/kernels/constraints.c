/* Constraints that are products of two vectors linear in nodal vectors, see `quadratic.py`. */
#include <math.h>

/* The sum of a vector's nodes with its weights, and its constant. */
static void factor(int k, const double *weights, const double *constant, const double *y, double *v)
{
    for (int i = 0; i < 3; i++) {
        v[i] = constant[i];
        for (int a = 0; a < k; a++)
            v[i] += weights[a] * y[3 * a + i];
    }
}

/* Residual, tangent and gap of n elements of k nodes and m constraints, by nodes and multipliers; what they are written to
 * holds zeros.
 *   weights, constants, values: of their equations; start: both factors of each constraint at t_n
 *   curvature: second derivatives by the nodes, those of a constraint in a row
 *   y: nodes at t_{n+1}; multipliers: factor of the step times lambda; scales: of the unknowns
 *   lent: compliance over that of the bodies that a constraint is lent */
void constraints(int k, int m, double theta, long n, const double *weights, const double *constants, const double *values,
                 const double *start, const double *curvature, const double *y, const double *multipliers,
                 const double *scales, const double *lent, double *residuals, double *tangents, double *gaps)
{
    int last = 3 * k, size = last + m;
    for (long e = 0; e < n; e++, y += last, residuals += size, tangents += (long)size * size) {
        for (int c = 0; c < m; c++, weights += 2 * k, constants += 6, start += 6, curvature += k * k) {
            const double *own[2] = {weights, weights + k};
            double end[2][3], middle[2][3], gap = -values[e * m + c], force = multipliers[e * m + c], bent = 0.0;
            int row = last + c;
            for (int f = 0; f < 2; f++) {
                factor(k, own[f], constants + 3 * f, y, end[f]);
                for (int i = 0; i < 3; i++)
                    middle[f][i] = start[3 * f + i] + theta * (end[f][i] - start[3 * f + i]);
            }
            for (int i = 0; i < 3; i++)
                gap += end[0][i] * end[1][i];
            for (int a = 0; a < k; a++) {
                if (own[0][a] == 0.0 && own[1][a] == 0.0)
                    continue;
                for (int i = 0; i < 3; i++) {
                    double mean = own[0][a] * middle[1][i] + own[1][a] * middle[0][i];
                    residuals[3 * a + i] += force * mean;
                    tangents[(3 * a + i) * size + row] = scales[e] * mean;
                    tangents[row * size + 3 * a + i] = scales[e] * (own[0][a] * end[1][i] + own[1][a] * end[0][i]);
                }
                for (int b = 0; b < k; b++) {
                    double bend = curvature[k * a + b];
                    bent = fmax(bent, fabs(bend));
                    for (int i = 0; bend != 0.0 && i < 3; i++)
                        tangents[(3 * a + i) * size + 3 * b + i] += theta * force * bend;
                }
            }
            gaps[e * m + c] = gap;
            residuals[row] = scales[e] * gap;
            if (lent[e] > 0.0)
                tangents[row * size + row] = -scales[e] * (lent[e] + fabs(gap) * bent);
        }
    }
}
