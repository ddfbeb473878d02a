/* The element of node-to-surface contact, pair after pair.

   `condensed` is contact/facet_gap.py, _condensed, with kernels/nts_element.py, element, of the
   mean-value rule, which have the numbers of the formulas and are compared with this by
   tests/kernels/test_compiled.py. Of the invariants (theory 3) it takes only the sums that they
   stand in: with v = sum_I v_I y_I for each set of weights, v_I y_I . y_J u_J = v . u. */

#include "nts_element.h"

static inline double mix(double t, double a, double b) { return (1.0 - t) * a + t * b; }

static inline void cross(const double *a, const double *b, double factor, double *out)
{
    for (int i = 0; i < 3; i++)
        out[i] = factor * (a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
}

INLINE void clear(int size, double *out)
{
    for (int i = 0; i < size; i++)
        out[i] = 0.0;
}

static inline void invert(double a[2][2])
{
    double determinant = a[0][0] * a[1][1] - a[0][1] * a[1][0], first = a[0][0];
    a[0][0] = a[1][1] / determinant;
    a[1][1] = first / determinant;
    a[0][1] /= -determinant;
    a[1][0] /= -determinant;
}

/* At the end, where d and f fit the points: d(d, f)/dy, as bend (2, size) of d's parts along the dual
   directions and as `foot` of f. */
INLINE void end_of(int nc, const Facet *facet, Place *p, double (*dual)[3], double (*bend)[WIDTH], Pair *out)
{
    int size = 3 * nc;
    double metric[2][2], slope[2][2], curved[2][2], away[2][WIDTH];
    Shape n;
    Sums s;
    shape(facet, p->f[1], 2, n);
    sums(nc, n, p->y[1], s);
    memcpy(out->n, n[0][0], nc * sizeof(double));
    cross(s[1], s[2], 1.0, p->d[1]);
    double area = sqrt(dot(p->d[1], p->d[1]));
    for (int i = 0; i < 3; i++)
        p->d[1][i] /= area;
    out->gap = -dot(s[0], p->d[1]);
    for (int a = 0; a < 2; a++) {
        for (int b = 0; b < 2; b++) {
            metric[a][b] = dot(s[1 + a], s[1 + b]);
            slope[a][b] = metric[a][b] + dot(s[3 + a + b], s[0]);
            curved[a][b] = dot(s[3 + a + b], p->d[1]);
        }
        clear(size, away[a]);
        outer(nc, 1.0, n[0][0], s[1 + a], away[a]);
        outer(nc, 1.0, n[1][a], s[0], away[a]);
    }
    invert(metric);
    invert(slope);
    for (int a = 0; a < 2; a++) {
        for (int i = 0; i < size; i++)
            out->foot[a][i] = -slope[a][0] * away[0][i] - slope[a][1] * away[1][i];
        for (int k = 0; k < 3; k++)
            dual[a][k] = metric[a][0] * s[1][k] + metric[a][1] * s[2][k];
    }
    for (int a = 0; a < 2; a++) {
        for (int i = 0; i < size; i++)
            bend[a][i] = curved[a][0] * out->foot[0][i] + curved[a][1] * out->foot[1][i];
        outer(nc, 1.0, n[1][a], p->d[1], bend[a]);
    }
}

INLINE void evaluate(int nc, const Rule *rule, Place *p, double normal, const double *t, Pair *out)
{
    const Facet *facet = &rule->facet;
    int size = 3 * nc, bent = facet->degree == 1 ? 2 : 3, points = rule->points;
    double dual[2][3], bend[2][WIDTH], dm[3], ym[CONTROL][3];
    Shape shapes[MOST_POINTS];
    Sums ends[MOST_POINTS][2], middle[MOST_POINTS];
    double mean[CONTROL], along[2][CONTROL], hold[2][WIDTH];
    double foot[3] = {0.0}, tangent[2][3] = {{0.0}}, lift[2] = {0.0}, turn[2][2] = {{0.0}}, metric[2][2] = {{0.0}};

    clear(nc, mean);
    for (int a = 0; a < 2; a++) {
        clear(nc, along[a]);
        clear(size, hold[a]);
    }
    end_of(nc, facet, p, dual, bend, out);
    for (int k = 0; k < 3; k++) {
        dm[k] = 0.5 * (p->d[0][k] + p->d[1][k]);
        for (int i = 0; i < nc; i++)
            ym[i][k] = 0.5 * (p->y[0][i][k] + p->y[1][i][k]);
    }
    /* The mean gradients of the six constraints (43). */
    for (int q = 0; q < points; q++) {
        double tau = rule->tau[q], w = rule->weight[q], f[2];
        const Sums *e = ends[q];
        Shape *n = &shapes[q];
        for (int b = 0; b < 2; b++)
            f[b] = mix(tau, p->f[0][b], p->f[1][b]);
        shape(facet, f, bent, *n);
        for (int end = 0; end < 2; end++)
            sums(nc, *n, p->y[end], ends[q][end]);
        for (int k = 0; k < SUMS; k++)
            for (int i = 0; i < 3; i++)
                middle[q][k][i] = 0.5 * (e[0][k][i] + e[1][k][i]);
        axpy(nc, w, (*n)[0][0], mean);
        axpy(3, w, middle[q][0], foot);
        for (int a = 0; a < 2; a++) {
            axpy(nc, w, (*n)[1][a], along[a]);
            axpy(3, w, middle[q][1 + a], tangent[a]);
            outer(nc, -w, (*n)[0][0], middle[q][1 + a], hold[a]);
            outer(nc, -w, (*n)[1][a], middle[q][0], hold[a]);
            lift[a] += w * mix(tau, dot(e[0][1 + a], p->d[0]), dot(e[1][1 + a], p->d[1]));
            for (int b = 0; b < 2; b++) {
                turn[a][b] += w * mix(tau, dot(e[0][3 + a + b], p->d[0]), dot(e[1][3 + a + b], p->d[1]));
                metric[a][b] += w * mix(tau, dot(e[0][1 + a], e[0][1 + b]) + dot(e[0][3 + a + b], e[0][0]),
                                        dot(e[1][1 + a], e[1][1 + b]) + dot(e[1][3 + a + b], e[1][0]));
            }
        }
    }
    /* The multipliers that hold the rows of d and f, in which they are linear: of one unit of lambda_N. */
    double against[3][3], unit[5], lambda[5];
    cross(tangent[1], dm, 1.0, against[0]);
    double volume = dot(tangent[0], against[0]);
    cross(tangent[1], dm, 1.0 / volume, against[0]);
    cross(dm, tangent[0], 1.0 / volume, against[1]);
    cross(tangent[0], tangent[1], 1.0 / volume, against[2]);
    invert(metric);
    for (int i = 0; i < 3; i++)
        unit[i] = dot(against[i], foot);
    for (int a = 0; a < 2; a++) {
        unit[3 + a] = 0.0;
        for (int b = 0; b < 2; b++)
            unit[3 + a] += metric[a][b] * (unit[0] * turn[0][b] + unit[1] * turn[1][b] - lift[b]);
    }
    for (int i = 0; i < 5; i++)
        lambda[i] = normal * unit[i];
    double pressed[CONTROL];
    for (int i = 0; i < nc; i++)
        pressed[i] = unit[0] * along[0][i] + unit[1] * along[1][i] - mean[i];
    clear(size, out->by_normal);
    outer(nc, 1.0, pressed, dm, out->by_normal);
    for (int a = 0; a < 2; a++)
        axpy(size, unit[3 + a], hold[a], out->by_normal);
    for (int i = 0; i < size; i++)
        out->force[i] = normal * out->by_normal[i];
    for (int b = 0; b < rule->tangential; b++) {
        for (int i = 0; i < size; i++)
            out->by_slip[b][i] = metric[0][b] * hold[0][i] + metric[1][b] * hold[1][i];
        axpy(size, t[b], out->by_slip[b], out->force);
        for (int a = 0; a < 2; a++)
            lambda[3 + a] += metric[a][b] * t[b];
    }
    if (normal == 0.0 && (!rule->tangential || (t[0] == 0.0 && t[1] == 0.0))) {
        for (int i = 0; i < size; i++)
            clear(size, out->stiffness[i]);
        return;
    }

    /* D^2 pi by work, and the columns and rows of f, whose invariants change with it. */
    double still[CONTROL][CONTROL], column[2][WIDTH], row[2][WIDTH];
    double by_d[2][3] = {{0.0}}, of_d[2][3] = {{0.0}}, twice[2][2] = {{0.0}};
    for (int i = 0; i < nc; i++)
        clear(nc, still[i]);
    for (int a = 0; a < 2; a++) {
        clear(size, column[a]);
        clear(size, row[a]);
    }
    for (int q = 0; q < points; q++) {
        double tau = rule->tau[q], w = rule->weight[q], wt = w * tau, slope[CONTROL];
        const Sums *e = ends[q];
        const Shape *n = (const Shape *)&shapes[q];
        double s[3][3], tilt[2][3][3];
        for (int i = 0; i < nc; i++)
            slope[i] = lambda[3] * (*n)[1][0][i] + lambda[4] * (*n)[1][1][i];
        for (int i = 0; i < nc; i++)
            for (int j = 0; j < nc; j++)
                still[i][j] -= 0.5 * w * ((*n)[0][0][i] * slope[j] + slope[i] * (*n)[0][0][j]);
        for (int end = 0; end < 3; end++) {
            const double(*v)[3] = (const double(*)[3])(end < 2 ? e[end] : middle[q]);
            for (int k = 0; k < 3; k++) {
                s[end][k] = lambda[3] * v[1][k] + lambda[4] * v[2][k];
                for (int b = 0; b < 2; b++)
                    tilt[b][end][k] = lambda[3] * v[3 + b][k] + lambda[4] * v[4 + b][k];
            }
        }
        for (int b = 0; b < 2; b++) {
            double rise[CONTROL], bow[CONTROL];
            for (int i = 0; i < nc; i++) {
                bow[i] = lambda[3] * (*n)[2][b][i] + lambda[4] * (*n)[2][b + 1][i];
                rise[i] = lambda[0] * (*n)[2][b][i] + lambda[1] * (*n)[2][b + 1][i] - normal * (*n)[1][b][i];
            }
            for (int end = 1; end < 3; end++) {
                const double(*v)[3] = (const double(*)[3])(end < 2 ? e[end] : middle[q]);
                double *to = end < 2 ? row[b] : column[b], *of = end < 2 ? of_d[b] : by_d[b];
                outer(nc, -wt, (*n)[1][b], s[end], to);
                outer(nc, -wt, slope, v[1 + b], to);
                outer(nc, -wt, (*n)[0][0], tilt[b][end], to);
                outer(nc, -wt, bow, v[0], to);
                outer(nc, wt, rise, end < 2 ? p->d[1] : dm, to);
                for (int k = 0; k < 3; k++)
                    of[k] += wt * (lambda[0] * v[3 + b][k] + lambda[1] * v[4 + b][k] - normal * v[1 + b][k]);
            }
            for (int k = 0; k < 2; k++) {
                double both[2];
                for (int end = 0; end < 2; end++)
                    both[end] = -normal * dot(e[end][3 + b + k], p->d[end]) - dot(e[end][3 + b + k], s[end])
                                - dot(e[end][1 + b], tilt[k][end]) - dot(e[end][1 + k], tilt[b][end]);
                for (int a = 0; a < 2 && bent > 2; a++)
                    for (int end = 0; end < 2; end++) {
                        double third[3];
                        combine(nc, (*n)[3][a + b + k], p->y[end], third);
                        both[end] += lambda[a] * dot(third, p->d[end]) - lambda[3 + a] * dot(third, e[end][0]);
                    }
                twice[b][k] += wt * mix(tau, both[0], both[1]);
            }
        }
    }
    /* d(lambda_1..5)/dy, of which that of d . d acts on nothing but d. */
    double half[CONTROL], within = 0.5 * lambda[2], turned[2][WIDTH], moved[2][WIDTH], held[2][WIDTH];
    for (int i = 0; i < nc; i++)
        half[i] = 0.5 * (lambda[0] * along[0][i] + lambda[1] * along[1][i] - normal * mean[i]);
    for (int a = 0; a < 2; a++) {
        clear(size, turned[a]);
        outer(nc, 1.0, half, against[a], turned[a]);
        memcpy(moved[a], row[a], size * sizeof(double));
        for (int b = 0; b < 2; b++) {
            axpy(size, -within * dot(against[a], dual[b]), bend[b], turned[a]);
            axpy(size, dot(against[a], by_d[b]), out->foot[b], turned[a]);
            axpy(size, -dot(of_d[a], dual[b]), bend[b], moved[a]);
            axpy(size, twice[a][b], out->foot[b], moved[a]);
        }
    }
    for (int a = 0; a < 2; a++) {
        clear(size, held[a]);
        for (int b = 0; b < 2; b++) {
            axpy(size, -metric[a][b], moved[b], held[a]);
            for (int c = 0; c < 2; c++)
                axpy(size, metric[a][b] * turn[c][b], turned[c], held[a]);
        }
    }
    for (int i = 0; i < nc; i++)
        for (int k = 0; k < 3; k++) {
            double *restrict to = out->stiffness[3 * i + k];
            clear(size, to);
            for (int j = 0; j < nc; j++)
                to[3 * j + k] = still[i][j];
            for (int a = 0; a < 2; a++) {
                double one = half[i] * dual[a][k], two = column[a][3 * i + k], three = along[a][i] * dm[k],
                       four = hold[a][3 * i + k];
                for (int j = 0; j < size; j++)
                    to[j] += two * out->foot[a][j] - one * bend[a][j] - three * turned[a][j] - four * held[a][j];
            }
        }
}

void place_of(int nc, const double *x0, const double *x1, const double *d0, const double *f0, const double *f1, Place *p)
{
    for (int k = 0; k < 3; k++) {
        for (int i = 0; i < nc; i++) {
            p->y[0][i][k] = x0[3 * (i + 1) + k] - x0[k];
            p->y[1][i][k] = x1[3 * (i + 1) + k] - x1[k];
        }
        p->d[0][k] = d0[k];
    }
    for (int b = 0; b < 2; b++) {
        p->f[0][b] = f0[b];
        p->f[1][b] = f1[b];
    }
}

/* What x_s, the first, has of the others' (3 nc). */
static void close(int nc, double factor, const double *y, double *out)
{
    out[0] = out[1] = out[2] = 0.0;
    for (int i = 0; i < nc; i++)
        for (int k = 0; k < 3; k++) {
            out[k] -= factor * y[3 * i + k];
            out[3 * (i + 1) + k] = factor * y[3 * i + k];
        }
}

static void of_three(const Rule *rule, Place *p, double normal, const double *t, Pair *out)
{
    evaluate(3, rule, p, normal, t, out);
}

static void of_four(const Rule *rule, Place *p, double normal, const double *t, Pair *out)
{
    evaluate(4, rule, p, normal, t, out);
}

static void of_any(const Rule *rule, Place *p, double normal, const double *t, Pair *out)
{
    evaluate(rule->facet.nc, rule, p, normal, t, out);
}

void pair_of(const Rule *rule, Place *p, double normal, const double *t, Pair *out)
{
    (rule->facet.nc == 3 ? of_three : rule->facet.nc == 4 ? of_four : of_any)(rule, p, normal, t, out);
}

/* The metric at the mean of the ends' invariants, over the facet's size squared, and its gradient. */
static void metric_of(const Rule *rule, const Place *p, const Pair *pair, double length, double *metric,
                      double *gradient)
{
    int nc = rule->facet.nc, outer_size = 3 * (nc + 1) + 3;
    double f[2] = {0.5 * (p->f[0][0] + p->f[1][0]), 0.5 * (p->f[0][1] + p->f[1][1])}, per = 0.5 / (length * length);
    Shape n;
    Sums s[2];
    shape(&rule->facet, f, 2, n);
    for (int end = 0; end < 2; end++)
        sums(nc, n, p->y[end], s[end]);
    for (int a = 0; a < 2; a++)
        for (int b = 0; b < 2; b++) {
            double row[WIDTH] = {0.0};
            outer(nc, 1.0, n[1][a], s[1][1 + b], row);
            outer(nc, 1.0, n[1][b], s[1][1 + a], row);
            metric[2 * a + b] = 0.0;
            for (int end = 0; end < 2; end++) {
                metric[2 * a + b] += per * dot(s[end][1 + a], s[end][1 + b]);
                for (int c = 0; c < 2; c++) {
                    double by_f = dot(s[end][3 + a + c], s[end][1 + b]) + dot(s[end][3 + b + c], s[end][1 + a]);
                    axpy(3 * nc, 0.5 * by_f, pair->foot[c], row);
                }
            }
            close(nc, per, row, gradient + (2 * a + b) * outer_size);
        }
}

/* Arrays that are written come as zeros; those of the slip are not touched without friction. */
void condensed(const Facet *facet, int points, const double *tau, const double *weight, int tangential, long n,
               const double *x0, const double *x1, const double *d0, const double *f0, const double *f1,
               const double *length, const double *multiplier, double *residual, double *tangent, double *gap,
               double *slip_gradient, double *metric, double *metric_gradient)
{
    Rule rule = {*facet, points, tangential, tau, weight};
    int nc = facet->nc, places = 3 * (nc + 1), size = places + 1 + tangential;
    Place p;
    Pair pair;
    for (long i = 0; i < n; i++, residual += size, tangent += size * size, multiplier += 1 + tangential) {
        double t[2] = {0.0}, *last = tangent + places * size, column[WIDTH + 3];
        for (int b = 0; b < tangential; b++)
            t[b] = length[i] * multiplier[1 + b];
        place_of(nc, x0 + i * places, x1 + i * places, d0 + 3 * i, f0 + 2 * i, f1 + 2 * i, &p);
        pair_of(&rule, &p, multiplier[0], t, &pair);
        close(nc, 1.0, pair.force, residual);
        gap[i] = residual[places] = pair.gap;
        for (int j = 0; j < 3 * nc; j++)
            close(nc, 1.0, pair.stiffness[j], tangent + (3 + j) * size);
        for (int j = 0; j < 3 * nc; j++)
            for (int k = 0; k < places; k++)
                tangent[j % 3 * size + k] -= tangent[(3 + j) * size + k];
        for (int k = 0; k < 3; k++) {
            last[k] = p.d[1][k];
            for (int j = 0; j < nc; j++)
                last[3 * (j + 1) + k] = -pair.n[j] * p.d[1][k];
        }
        for (int m = 0; m < 1 + tangential; m++) {
            close(nc, m ? length[i] : 1.0, m ? pair.by_slip[m - 1] : pair.by_normal, column);
            for (int j = 0; j < places; j++)
                tangent[j * size + places + m] = column[j];
        }
        for (int b = 0; b < tangential; b++)
            close(nc, length[i], pair.foot[b], slip_gradient + (2 * i + b) * size);
        if (tangential)
            metric_of(&rule, &p, &pair, length[i], metric + 4 * i, metric_gradient + 4 * i * size);
    }
}
