/* The laws of contact and friction, pair after pair, and what stands before and after them.

   tests/twins has the same in NumPy, which tests/kernels/test_compiled.py compares with this. */

#include "contact_law.h"

/* ---- the laws */

/* Pull up to which a node that sticks is not let go. */
static double pull_of(const Law *law, const Slip *slip, double c, const double *t, const double *unmoved)
{
    double friction = length(slip->metric, t);
    int resists = friction * friction + c * (t[0] * slip->value[0] + t[1] * slip->value[1]) > 0.0;
    return resists && !any(unmoved) ? law->pull * friction : 0.0;
}

/* Compliance lent to a pair that sticks, so that friction divides as normal forces do: a brick at rest on a slope
   just below the limit needs that of all its nodes. */
static double lent(const Law *law, const Together *together, double force, double scale)
{
    double part = law->uneven;
    if (force < 0.0)
        part = smaller(larger(together->force / -force, 1.0 / law->uneven), law->uneven);
    return together->tangential * part / scale;
}

/* Rows of lambda_T where it slips along the trial; `t` is lambda_T less what is held of it. */
static void slide(int size, const Slip *slip, const double *t, const double *trial, double length_of_trial,
                  double bound, double c, double *value, double (*by_multiplier)[2], double *by_bound, double *rows)
{
    const double *m = slip->metric, *s = slip->value;
    double unit[2], up[2], across[2][2], by_slip, by_metric[2][2];
    for (int a = 0; a < 2; a++)
        unit[a] = trial[a] / length_of_trial;
    raise(m, unit, up);
    for (int a = 0; a < 2; a++) {
        for (int b = 0; b < 2; b++) {
            across[a][b] = ((a == b) - unit[a] * up[b]) / length_of_trial;
            by_multiplier[a][b] = (a == b) - bound * across[a][b];
        }
        value[a] = t[a] - bound * unit[a];
        by_bound[a] = -unit[a];
    }
    for (int a = 0; a < 2; a++) {
        double *row = rows + a * size;
        memset(row, 0, size * sizeof(double));
        for (int b = 0; b < 2; b++) {
            by_slip = -bound * c * (across[a][0] * m[b] + across[a][1] * m[2 + b]);
            for (int d = 0; d < 2; d++)
                by_metric[b][d] = -bound * (c * across[a][b] * s[d] + 0.5 * unit[a] * up[b] * up[d]);
            for (int z = 0; z < size; z++)
                row[z] += by_slip * slip->gradient[b * size + z];
        }
        for (int b = 0; b < 2; b++)
            for (int d = 0; d < 2; d++) {
                const double *gradient = slip->metric_gradient + (2 * b + d) * size;
                for (int z = 0; z < size; z++)
                    row[z] += by_metric[b][d] * gradient[z];
            }
    }
}

/* The rows of lambda_T [kg m] of a pair that touches as if it hardly rubbed. */
static void rub_hardly(const Law *law, const Slip *slip, const double *end, double of_end, double scale,
                       double yielding, double *residual, double *tangent)
{
    const double *t = end + (law->size - law->row) - 2, *m = slip->metric, *s = slip->value;
    double stiffness = law->hardly * yielding;
    int size = law->size, last = size - 2;
    for (int a = 0; a < 2; a++) {
        double *row = tangent + (last + a) * size;
        residual[last + a] = (t[a] - stiffness * (m[2 * a] * s[0] + m[2 * a + 1] * s[1])) / scale;
        for (int z = 0; z < size; z++)
            row[z] = -stiffness / scale * (m[2 * a] * slip->gradient[z] + m[2 * a + 1] * slip->gradient[size + z]);
        row[last + a] += of_end / scale;
    }
}

/* Add to a row what follows from the change of the coefficient with slip and force; `by` is the derivative of the row
   by the coefficient. */
static void follow(int size, const Slip *slip, double by, double by_slip, double by_force, double *row, int normal)
{
    const double *m = slip->metric, *s = slip->value;
    double distance = distance_of(slip);
    row[normal] -= by * by_force;
    for (int z = 0; distance > 0.0 && z < size; z++) {
        double along = 0.0;
        for (int a = 0; a < 2; a++) {
            along += (m[2 * a] * s[0] + m[2 * a + 1] * s[1]) * slip->gradient[a * size + z];
            for (int b = 0; b < 2; b++)
                along += 0.5 * s[a] * s[b] * slip->metric_gradient[(2 * a + b) * size + z];
        }
        row[z] += by * by_slip * along / distance;
    }
}

/* The rows of lambda_T of an active pair by Coulomb's law for the trial t + c m s (theory 6): it sticks within the
   bound, else it slips along the trial. Returned is whether it sticks.

   For a pair without force yet under strong friction, and for rigid bodies, the bound is mu times the force that the
   gap asks for, as in the active set. With a bound of zero the pair would have to slip at first, by the slope of the
   bound, which is mu for all active pairs. Points of a rigid body that rest would go on so, by rounding and against
   each other. */
static int rub(const Law *law, long i, const Together *together, const Slip *slip, const double *end, double of_end,
               double scale, double yielding, double c, const double *unmoved, const double *held, double *residual,
               double *tangent)
{
    static const double NONE[4] = {0.0};
    const double *t = end + (law->size - law->row) - 2, *m = slip->metric, *s = slip->value;
    const double *by_gap = tangent + law->row * law->size;
    int size = law->size, last = size - 2, stick;
    int new = end[0] >= 0.0 && (law->strong || law->redundant);
    double mu = law->coefficients ? law->coefficients[i] : law->coefficient;
    double *value = residual + last, *rows = tangent + last * size;
    double bound = mu * (law->strong ? -end[0] : larger(-end[0], 0.0)), loose[4], less[2], trial[2];
    if (new)
        bound -= mu * yielding * residual[law->row];
    if (law->endless)
        bound = INFINITY;
    if (!unmoved)
        unmoved = held = NONE;
    for (int a = 0; a < 4; a++)
        loose[a] = (a % 3 == 0) - held[a];
    for (int a = 0; a < 2; a++)
        less[a] = loose[2 * a] * t[0] + loose[2 * a + 1] * t[1];
    if (!law->endless && any(unmoved) && !any(held)) {
        /* What is made to slip cannot stick. Where solved, trial and slip are parallel, whatever c: no slope of c. */
        double made = 2.0 * bound / distance_of(slip);
        c = made <= c ? c : made;
    }
    for (int a = 0; a < 2; a++)
        trial[a] = less[a] + c * (m[2 * a] * s[0] + m[2 * a + 1] * s[1]);
    double size_of_trial = length(m, trial);
    stick = size_of_trial <= bound;
    const double *unsaid = stick ? unmoved : held;
    if (stick) {
        memcpy(value, s, 2 * sizeof(double));
        memcpy(rows, slip->gradient, 2 * size * sizeof(double));
        for (int a = 0; a < 2; a++)
            for (int b = 0; b < 2; b++) {
                /* What is prescribed is no sticking, and not zero where it is that of a sum. */
                double part = unmoved[2 * b + a];
                value[a] -= part * s[b];
                for (int z = 0; part != 0.0 && z < size; z++)
                    rows[a * size + z] -= part * slip->gradient[b * size + z];
            }
    } else {
        double by_multiplier[2][2], by_bound[2];
        slide(size, slip, less, trial, size_of_trial, bound, c, value, by_multiplier, by_bound, rows);
        for (int a = 0; a < 2; a++) {
            double *row = rows + a * size;
            for (int b = 0; b < 2; b++)
                row[last + b] += of_end * (by_multiplier[a][0] * loose[b] + by_multiplier[a][1] * loose[2 + b]);
            row[law->row] -= mu * of_end * by_bound[a];
            for (int z = 0; new && z < size; z++)
                row[z] -= mu * yielding * by_bound[a] * by_gap[z];
            if (law->coefficients && !law->endless)
                follow(size, slip, by_bound[a] * bound / mu, law->by_slip[i], law->by_force[i], row, law->row);
            value[a] /= scale;
            for (int z = 0; z < size; z++)
                row[z] /= scale;
        }
    }
    for (int a = 0; a < 2; a++) {
        for (int b = 0; b < 2; b++) {
            value[a] += unsaid[2 * a + b] / scale * t[b];
            rows[a * size + last + b] += of_end * unsaid[2 * a + b] / scale;
        }
        if (stick && together->tangential != 0.0)
            rows[a * size + last + a] -= lent(law, together, end[0], scale);
    }
    return stick;
}

/* Semi-smooth laws of contact (theory 9) and friction: g_N = 0 where active, else lambda_N = 0; there Coulomb's law,
   else lambda_T = 0. These are the forces of the step, but at massless nodes those of its end: theirs of the step are
   the mean of both ends (theory 16). With mass in rows and columns the whole matrix is in kg, whatever the size of the
   scene.

   Residual (n, size), tangent (n, size, size) and slip come as of the element, and leave as of the step; `held`,
   `normal` and `let_go` may be NULL as `unmoved` and the slip. */
void laws(const Law *law, const Together *together, long n, const double *gap, const double *value,
          const double *gradient, const double *metric, const double *metric_gradient, const double *multiplier,
          const double *held, const double *normal, const unsigned char *let_go, double *residual, double *tangent, double *end,
          unsigned char *active, unsigned char *stick, double *distance, double *force, double *tangential)
{
    int size = law->size, row = law->row, constraints = size - row;
    for (long i = 0; i < n; i++) {
        const double *unmoved = law->unmoved ? law->unmoved + 4 * i : NULL;
        double scale = law->scale[i], of_end = 1.0, none = law->none[i], c = 0.0;
        double *r = residual + i * size, *k = tangent + i * size * size, *last = end + i * constraints;
        double *gap_row = k + row * size;
        Slip slip = {NULL, NULL, NULL, NULL};
        memcpy(last, multiplier + i * constraints, constraints * sizeof(double));
        if (law->before && !isnan(law->before[3 * i])) {
            of_end = 2.0;
            for (int j = 0; j < constraints; j++)
                last[j] *= 2.0;
            last[0] -= law->before[3 * i];
            for (int a = 0; law->friction && a < 2; a++)
                last[constraints - 2 + a] -= law->before[3 * i + 1 + a];
        }
        if (law->friction) {
            slip.value = value + 2 * i;
            slip.gradient = gradient + 2 * i * size;
            slip.metric = metric + 4 * i;
            slip.metric_gradient = metric_gradient + 4 * i * size;
            c = law->tangential_scale[i];
            if (law->pull > 0.0)
                none -= pull_of(law, &slip, c, last + constraints - 2, unmoved);
        }
        active[i] = -last[0] - law->yielding[i] * (gap[i] > 0.0 ? law->opening : 1.0) * gap[i] > none
                    && !(let_go && let_go[i]);
        stick[i] = 0;
        distance[i] = active[i] && law->friction ? distance_of(&slip) : 0.0;
        Press press = {larger(-last[0], 0.0), -of_end, 0.0};
        if (law->gap_width > 0.0 && !(let_go && let_go[i]))
            active[i] = blur_gap(law, last[0], of_end, law->yielding[i], r, k, &press);
        else if (active[i])
            gap_row[row] -= together[i].normal / scale;
        if (active[i] || (law->gap_width > 0.0 && !(let_go && let_go[i]))) {
            if (law->hardly > 0.0)
                rub_hardly(law, &slip, last, of_end, scale, law->yielding[i], r, k);
            else if (law->friction && law->width > 0.0)
                stick[i] = blur_slip(law, law->coefficients ? law->coefficients[i] : law->coefficient, &slip, last,
                                     of_end, scale, &press, r, k);
            else if (law->friction)
                stick[i] = rub(law, i, together + i, &slip, last, of_end, scale, law->yielding[i], c, unmoved,
                               unmoved ? held + 4 * i : NULL, r, k);
        } else {
            r[row] = last[0] / scale;
            memset(gap_row, 0, size * sizeof(double));
            gap_row[row] = of_end / scale;
            for (int j = size - 2; law->friction && j < size; j++) {
                r[j] = last[j - row] / scale;
                memset(k + j * size, 0, size * sizeof(double));
                k[j * size + j] = of_end / scale;
            }
        }
        for (int a = 0; a < 3; a++)
            force[3 * i + a] = -r[a];
        if (law->friction) {
            double along = dot(force + 3 * i, normal + 3 * i);
            for (int a = 0; a < 3; a++)
                tangential[3 * i + a] = force[3 * i + a] - along * normal[3 * i + a];
        }
        for (int j = row; j < size; j++) {
            r[j] *= scale;
            for (int z = 0; z < size; z++)
                k[j * size + z] *= scale;
            for (int z = 0; z < size; z++)
                k[z * size + j] *= scale;
        }
    }
}

/* ---- the element without a facet */

/* The directions t_a are `directions` e_a less their part along the normal n where the force acts. Dual to them are
   t^a = e_a - n_0 (n . e_a) / (n . n_0), which lie along the surface, too, and t^a . t_b = t^a . e_b = 1 or 0, because
   n_0 . e_b = 0. The slip is t^a . (x_1 - x_0).

   Of each pair the rule's gradient of the gap and its derivative, the gap and its gradient at the end,
   gradient and curvature where the force acts, the normal and two directions along the surface at the
   start, motion and multipliers. Arrays that are written come as zeros. */
void obstacle(int constraints, double theta, long n, const double *gradient, const double *slope, const double *gap,
              const double *end, const double *middle, const double *bend, const double *normal0,
              const double *directions, const double *motion, const double *multiplier, double *residual,
              double *tangent, double *slip, double *slip_gradient, double *metric, double *metric_gradient)
{
    int size = 3 + constraints;
    for (long i = 0; i < n; i++) {
        const double *lambda = multiplier + i * constraints;
        double *r = residual + i * size, *k = tangent + i * size * size;
        r[3] = gap[i];
        for (int a = 0; a < 3; a++) {
            r[a] = lambda[0] * gradient[3 * i + a];
            k[a * size + 3] = gradient[3 * i + a];
            k[3 * size + a] = end[3 * i + a];
            for (int b = 0; b < 3; b++)
                k[a * size + b] = lambda[0] * slope[9 * i + 3 * a + b];
        }
        if (constraints == 1)
            continue;
        const double *n0 = normal0 + 3 * i, *d = motion + 3 * i, *t = lambda + 1;
        double per_height = dot(middle + 3 * i, n0), rise = dot(n0, d), n0_turn[3], part[2], turn[2][3], dual[2][3];
        per_height = per_height != 0.0 ? 1.0 / per_height : 0.0;
        for (int b = 0; b < 3; b++) {
            const double *column = bend + 9 * i + b;
            n0_turn[b] = theta * (n0[0] * column[0] + n0[1] * column[3] + n0[2] * column[6]);
        }
        for (int a = 0; a < 2; a++) {
            const double *e = directions + 6 * i + 3 * a;
            double *g = slip_gradient + (2 * i + a) * size, tilt;
            part[a] = dot(e, middle + 3 * i);
            tilt = part[a] * per_height;
            for (int b = 0; b < 3; b++) {
                const double *column = bend + 9 * i + b;
                turn[a][b] = theta * (e[0] * column[0] + e[1] * column[3] + e[2] * column[6]);
                double tilt_gradient = (turn[a][b] - tilt * n0_turn[b]) * per_height;
                dual[a][b] = e[b] - tilt * n0[b];
                g[b] = dual[a][b] - rise * tilt_gradient;
                for (int j = 0; j < 3; j++)
                    k[j * size + b] -= n0[j] * t[a] * tilt_gradient;
            }
            slip[2 * i + a] = dot(dual[a], d);
            for (int j = 0; j < 3; j++) {
                r[j] += t[a] * dual[a][j];
                k[j * size + 4 + a] = dual[a][j];
            }
        }
        for (int a = 0; a < 2; a++)
            for (int b = 0; b < 2; b++) {
                double *g = metric_gradient + (4 * i + 2 * a + b) * size;
                metric[4 * i + 2 * a + b] = (a == b) - part[a] * part[b];
                for (int j = 0; j < 3; j++)
                    g[j] = -(part[a] * turn[b][j] + part[b] * turn[a][j]);
            }
    }
}

/* ---- points to nodes */

/* out (nodes, 3 columns), or (nodes, columns) in threes, from in (points, ..): the transpose of weights (points, nodes). */
static void spread(int points, int nodes, int columns, const double *weights, const double *in, double *out)
{
    for (int a = 0; a < nodes; a++) {
        double *to = out + a * columns;
        memset(to, 0, columns * sizeof(double));
        for (int p = 0; p < points; p++) {
            const double *from = in + p * columns, w = weights[p * nodes + a];
            for (int j = 0; w != 0.0 && j < columns; j++)
                to[j] += w * from[j];
        }
    }
}

/* Residual (n, 3 points + rest) and tangent of points as those of nodes; work is (3 points + rest,
   3 nodes + rest). */
void to_nodes(int points, int nodes, int rest, long n, const double *weights, const double *residual,
              const double *tangent, double *work, double *out_residual, double *out_tangent)
{
    int size = 3 * points + rest, width = 3 * nodes + rest;
    for (long i = 0; i < n; i++) {
        const double *w = weights + i * points * nodes, *r = residual + i * size, *k = tangent + i * size * size;
        double *out_r = out_residual + i * width, *out_k = out_tangent + i * width * width;
        spread(points, nodes, 3, w, r, out_r);
        memcpy(out_r + 3 * nodes, r + 3 * points, rest * sizeof(double));
        for (int j = 0; j < size; j++) {
            spread(points, nodes, 3, w, k + j * size, work + j * width);
            memcpy(work + j * width + 3 * nodes, k + j * size + 3 * points, rest * sizeof(double));
        }
        spread(points, nodes, 3 * width, w, work, out_k);
        memcpy(out_k + 3 * nodes * width, work + 3 * points * width, rest * width * sizeof(double));
    }
}

/* ---- what forces on nodes do to a body */

/* Force and moment about the middle of the places of forces on nodes at y, both (n, nodes, 3), where
   these are not fixed; which nodes are places (n, nodes). */
void wrenches(int nodes, long n, const double *y, const double *push, const unsigned char *places,
              const unsigned char *fixed, double *out)
{
    for (long i = 0; i < n; i++, y += 3 * nodes, push += 3 * nodes, fixed += 3 * nodes, places += nodes, out += 6) {
        double middle[3] = {0.0}, number = 0.0;
        for (int k = 0; k < 6; k++)
            out[k] = 0.0;
        for (int a = 0; a < nodes; a++)
            if (places[a]) {
                number += 1.0;
                for (int k = 0; k < 3; k++)
                    middle[k] += y[3 * a + k];
            }
        for (int a = 0; a < nodes; a++) {
            double arm[3], force[3];
            for (int k = 0; k < 3; k++) {
                force[k] = fixed[3 * a + k] ? 0.0 : push[3 * a + k];
                arm[k] = y[3 * a + k] - (places[a] ? middle[k] / number : 0.0);
                out[k] += places[a] ? force[k] : 0.0;
            }
            for (int k = 0; k < 3; k++)
                out[3 + k] += arm[(k + 1) % 3] * force[(k + 2) % 3] - arm[(k + 2) % 3] * force[(k + 1) % 3];
        }
    }
}
