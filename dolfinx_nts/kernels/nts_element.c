/* The element of node-to-surface contact, pair after pair.

   `condensed` is contact/facet_gap.py, _condensed, with kernels/nts_element.py, element, of the
   mean-value rule, which have the numbers of the formulas and are compared with this by
   tests/kernels/test_compiled.py. */

#include "facets.h"

enum { PLACES = 3 * (CONTROL + 1), INNER = 5, SIZE = PLACES + INNER, CONSTRAINTS = 6 };

/* ---- invariants (theory 3): a place in their space, or a linear function of them, whose yy is
   symmetric and meets the whole matrix y_I . y_J */
typedef struct {
    double yy[CONTROL * CONTROL], yd[CONTROL], dd, f[2];
} Invariants;

/* What they are made of: y_I = x_I - x_s, d, f. */
typedef struct {
    double y[CONTROL][3], d[3], f[2];
} Place;

static void clear(int nc, Invariants *a)
{
    memset(a->yy, 0, nc * nc * sizeof(double));
    memset(a->yd, 0, nc * sizeof(double));
    a->dd = a->f[0] = a->f[1] = 0.0;
}

/* out += w a */
static void add(int nc, double w, const Invariants *a, Invariants *out)
{
    for (int i = 0; i < nc * nc; i++)
        out->yy[i] += w * a->yy[i];
    for (int i = 0; i < nc; i++)
        out->yd[i] += w * a->yd[i];
    out->dd += w * a->dd;
    for (int k = 0; k < 2; k++)
        out->f[k] += w * a->f[k];
}

static void between(int nc, const Invariants *a, const Invariants *b, double t, Invariants *out)
{
    clear(nc, out);
    add(nc, 1.0 - t, a, out);
    add(nc, t, b, out);
}

static void set_place(int nc, const double *x, const double *d, const double *f, Place *p)
{
    for (int k = 0; k < 3; k++) {
        for (int i = 0; i < nc; i++)
            p->y[i][k] = x[3 * (i + 1) + k] - x[k];
        p->d[k] = d[k];
    }
    memcpy(p->f, f, sizeof(p->f));
}

static void invariants(int nc, const Place *p, Invariants *out)
{
    for (int i = 0; i < nc; i++) {
        for (int j = 0; j <= i; j++)
            out->yy[i * nc + j] = out->yy[j * nc + i] = dot(p->y[i], p->y[j]);
        out->yd[i] = dot(p->y[i], p->d);
    }
    out->dd = dot(p->d, p->d);
    memcpy(out->f, p->f, sizeof(p->f));
}

/* The derivative by z = (x_s, x_I, d, f), at this place, of a linear function of the invariants. */
static void pull(int nc, const Invariants *a, const Place *p, double *out)
{
    double *by_d = out + 3 * (nc + 1);
    for (int k = 0; k < 3; k++) {
        out[k] = 0.0;
        by_d[k] = 2.0 * a->dd * p->d[k];
    }
    for (int i = 0; i < nc; i++) {
        double *by_x = out + 3 * (i + 1), row[3];
        combine(nc, a->yy + i * nc, p->y, row);
        for (int k = 0; k < 3; k++) {
            by_x[k] = 2.0 * row[k] + a->yd[i] * p->d[k];
            out[k] -= by_x[k];
            by_d[k] += a->yd[i] * p->y[i][k];
        }
    }
    by_d[3] = a->f[0];
    by_d[4] = a->f[1];
}

/* yy n */
static void times(int nc, const double *yy, const double *n, double *out)
{
    for (int i = 0; i < nc; i++)
        out[i] = sum(nc, yy + i * nc, n);
}

/* g += w dg/dpi of the six constraints (43) */
static void add_gradient(const Facet *facet, const Invariants *pi, double w, Invariants *g)
{
    int nc = facet->nc;
    Shape n;
    double yn[CONTROL], yt[2][CONTROL];
    shape(facet, pi->f, 2, n);
    times(nc, pi->yy, n[0][0], yn);
    g[3].dd += 0.5 * w;
    for (int a = 0; a < 2; a++)
        times(nc, pi->yy, n[1][a], yt[a]);
    for (int i = 0; i < nc; i++)
        g[0].yd[i] -= w * n[0][0][i];
    for (int a = 0; a < 2; a++) {
        const double *along = n[1][a];
        g[0].f[a] -= w * sum(nc, along, pi->yd);
        for (int i = 0; i < nc; i++) {
            g[1 + a].yd[i] += w * along[i];
            for (int j = 0; j < nc; j++)
                g[4 + a].yy[i * nc + j] -= 0.5 * w * (n[0][0][i] * along[j] + n[0][0][j] * along[i]);
        }
        for (int b = 0; b < 2; b++) {
            const double *bent = n[2][a + b];
            g[1 + a].f[b] += w * sum(nc, bent, pi->yd);
            g[4 + a].f[b] -= w * (sum(nc, n[1][b], yt[a]) + sum(nc, bent, yn));
        }
    }
}

/* c += w of the columns of d2(lambda . g)/dpi2 that belong to f */
static void add_curvature(const Facet *facet, const Invariants *pi, const double *lambda, double w, Invariants *c)
{
    int nc = facet->nc;
    Shape n;
    double slope[CONTROL], bent[2][CONTROL], ys[CONTROL], yb[2][CONTROL], yn[CONTROL], lift[CONTROL];
    shape(facet, pi->f, 3, n);
    for (int i = 0; i < nc; i++) {
        slope[i] = lambda[4] * n[1][0][i] + lambda[5] * n[1][1][i];
        for (int b = 0; b < 2; b++)
            bent[b][i] = lambda[4] * n[2][b][i] + lambda[5] * n[2][b + 1][i];
    }
    times(nc, pi->yy, n[0][0], yn);
    times(nc, pi->yy, slope, ys);
    for (int i = 0; i < nc; i++)
        lift[i] = lambda[0] * pi->yd[i] + ys[i];
    for (int b = 0; b < 2; b++)
        times(nc, pi->yy, bent[b], yb[b]);
    for (int b = 0; b < 2; b++) {
        const double *along = n[1][b];
        for (int i = 0; i < nc; i++) {
            c[b].yd[i] += w * (lambda[1] * n[2][b][i] + lambda[2] * n[2][b + 1][i] - lambda[0] * along[i]);
            for (int j = 0; j < nc; j++)
                c[b].yy[i * nc + j] -= 0.5 * w * (along[i] * slope[j] + n[0][0][i] * bent[b][j]
                                                  + along[j] * slope[i] + n[0][0][j] * bent[b][i]);
        }
        for (int k = 0; k < 2; k++) {
            double ff = -sum(nc, n[2][b + k], lift) - sum(nc, along, yb[k]) - sum(nc, n[1][k], yb[b]);
            for (int a = 0; a < 2; a++)
                for (int i = 0; i < nc; i++)
                    ff += n[3][a + b + k][i] * (lambda[1 + a] * pi->yd[i] - lambda[4 + a] * yn[i]);
            c[b].f[k] += w * ff;
        }
    }
}

/* ---- small systems: a (5, 5) and b (5, columns) are overwritten, b by the solutions */
static void solve(double (*a)[INNER], double (*b)[PLACES + 3], int columns)
{
    for (int k = 0; k < INNER; k++) {
        int best = k;
        for (int i = k + 1; i < INNER; i++)
            if (fabs(a[i][k]) > fabs(a[best][k]))
                best = i;
        for (int j = 0; j < INNER; j++) {
            double t = a[k][j];
            a[k][j] = a[best][j];
            a[best][j] = t;
        }
        for (int j = 0; j < columns; j++) {
            double t = b[k][j];
            b[k][j] = b[best][j];
            b[best][j] = t;
        }
        for (int i = k + 1; i < INNER; i++) {
            double factor = a[i][k] / a[k][k];
            for (int j = k + 1; j < INNER; j++)
                a[i][j] -= factor * a[k][j];
            for (int j = 0; j < columns; j++)
                b[i][j] -= factor * b[k][j];
        }
    }
    for (int k = INNER - 1; k >= 0; k--) {
        for (int i = k + 1; i < INNER; i++)
            for (int j = 0; j < columns; j++)
                b[k][j] -= a[k][i] * b[i][j];
        for (int j = 0; j < columns; j++)
            b[k][j] /= a[k][k];
    }
}

/* ---- the condensed element */
typedef struct {
    Facet facet;
    int points, tangential;
    const double *tau, *weight;
} Rule;

/* D pi(z_m)^T H D pi(z_1) + 1/2 work . D^2 pi, where H has these columns of f */
static void stiffness(int nc, const Invariants *c, const Invariants *work, const Place *middle,
                      const Place *end, double (*k)[SIZE])
{
    int places = 3 * (nc + 1), size = places + INNER;
    double point[CONTROL + 2][CONTROL + 2] = {{0.0}}, column[SIZE], row[SIZE];
    for (int i = 0; i < nc; i++) {
        double *own = point[i + 1];
        for (int j = 0; j < nc; j++)
            own[j + 1] = work->yy[i * nc + j];
        own[nc + 1] = point[nc + 1][i + 1] = 0.5 * work->yd[i];
        for (int j = 1; j < nc + 2; j++)
            own[0] -= j <= nc ? own[j] : 0.0;
        point[0][i + 1] = own[0];
        point[0][0] -= own[0];
        point[0][nc + 1] -= own[nc + 1];
        point[nc + 1][0] = point[0][nc + 1];
    }
    point[nc + 1][nc + 1] = work->dd;
    for (int i = 0; i < size; i++)
        memset(k[i], 0, size * sizeof(double));
    for (int i = 0; i < nc + 2; i++)
        for (int j = 0; j < nc + 2; j++)
            for (int m = 0; m < 3; m++)
                k[3 * i + m][3 * j + m] = point[i][j];
    for (int b = 0; b < 2; b++) {
        int f = size - 2 + b;
        pull(nc, &c[b], middle, column);
        pull(nc, &c[b], end, row);
        for (int i = 0; i < size; i++)
            k[i][f] += column[i];
        for (int i = 0; i < size - 2; i++)
            k[f][i] += row[i];
    }
}

/* Slip's gradient and the metric with its own, from d(d, f)/dx = -inner. */
static void slip_of_pair(const Rule *rule, const Invariants *mean, const Place *end, double length,
                         double (*inner)[PLACES + 3], double *gradient, double *metric, double *metric_gradient)
{
    int nc = rule->facet.nc, places = 3 * (nc + 1), outer = places + 3;
    double area = length * length, yt[2][CONTROL], row[SIZE];
    Shape n;
    shape(&rule->facet, mean->f, 2, n);
    for (int a = 0; a < 2; a++) {
        times(nc, mean->yy, n[1][a], yt[a]);
        for (int i = 0; i < places; i++)
            gradient[a * outer + i] = -length * inner[3 + a][i];
    }
    for (int a = 0; a < 2; a++)
        for (int b = 0; b < 2; b++) {
            Invariants g;
            double *out = metric_gradient + (2 * a + b) * outer;
            clear(nc, &g);
            metric[2 * a + b] = sum(nc, n[1][a], yt[b]) / area;
            for (int i = 0; i < nc; i++)
                for (int j = 0; j < nc; j++)
                    g.yy[i * nc + j] = 0.5 * (n[1][a][i] * n[1][b][j] + n[1][a][j] * n[1][b][i]);
            for (int c = 0; c < 2; c++)
                g.f[c] = sum(nc, n[2][a + c], yt[b]) + sum(nc, n[2][b + c], yt[a]);
            pull(nc, &g, end, row);
            for (int i = 0; i < places; i++) {
                double total = row[i];
                for (int k = 0; k < INNER; k++)
                    total -= row[places + k] * inner[k][i];
                out[i] = 0.5 * total / area;
            }
        }
}

static void condensed_one(const Rule *rule, const double *x0, const double *x1, const double *d0,
                          const double *f0, const double *f1, double length, const double *multiplier,
                          double *residual, double *tangent, double *gap, double *slip_gradient,
                          double *metric, double *metric_gradient)
{
    const Facet *facet = &rule->facet;
    int nc = facet->nc, places = 3 * (nc + 1), outer = places + 1 + rule->tangential;
    Place start, end, middle;
    Invariants pi0, pi1, pi, mean[CONSTRAINTS], here[CONSTRAINTS], work, c[2];
    Shape n;
    double by_mean[CONSTRAINTS][SIZE], by_end[CONSTRAINTS][SIZE], k[SIZE][SIZE];
    double a[INNER][INNER], hidden[INNER][PLACES + 3], held[INNER][PLACES + 3], t[2][3], normal[3];

    set_place(nc, x0, d0, f0, &start);
    shape(facet, f1, 1, n);
    for (int b = 0; b < 2; b++)
        combine(nc, n[1][b], (const double(*)[3])(x1 + 3), t[b]);
    for (int i = 0; i < 3; i++)
        normal[i] = t[0][(i + 1) % 3] * t[1][(i + 2) % 3] - t[0][(i + 2) % 3] * t[1][(i + 1) % 3];
    double area = sqrt(dot(normal, normal));
    for (int i = 0; i < 3; i++)
        normal[i] /= area;
    set_place(nc, x1, normal, f1, &end);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < nc; j++)
            middle.y[j][i] = 0.5 * (start.y[j][i] + end.y[j][i]);
        middle.d[i] = 0.5 * (start.d[i] + end.d[i]);
    }
    invariants(nc, &start, &pi0);
    invariants(nc, &end, &pi1);
    for (int i = 0; i < CONSTRAINTS; i++) {
        clear(nc, &mean[i]);
        clear(nc, &here[i]);
    }
    for (int p = 0; p < rule->points; p++) {
        between(nc, &pi0, &pi1, rule->tau[p], &pi);
        add_gradient(facet, &pi, rule->weight[p], mean);
    }
    add_gradient(facet, &pi1, 1.0, here);
    for (int i = 0; i < CONSTRAINTS; i++) {
        pull(nc, &mean[i], &middle, by_mean[i]);
        pull(nc, &here[i], &end, by_end[i]);
    }

    /* The multipliers that hold the rows of d and f, in which they are linear. */
    double lambda[CONSTRAINTS] = {multiplier[0]};
    for (int i = 0; i < INNER; i++) {
        held[i][0] = -multiplier[0] * by_mean[0][places + i];
        for (int j = 0; j < INNER; j++)
            a[i][j] = by_mean[j + 1][places + i];
    }
    for (int b = 0; b < rule->tangential; b++)
        held[3 + b][0] -= length * multiplier[1 + b];
    solve(a, held, 1);
    clear(nc, &work);
    for (int b = 0; b < 2; b++)
        clear(nc, &c[b]);
    for (int i = 0; i < CONSTRAINTS; i++) {
        lambda[i] = i ? held[i - 1][0] : multiplier[0];
        add(nc, lambda[i], &mean[i], &work);
    }
    for (int p = 0; p < rule->points; p++) {
        between(nc, &pi0, &pi1, rule->tau[p], &pi);
        add_curvature(facet, &pi, lambda, rule->weight[p] * rule->tau[p], c);
    }
    stiffness(nc, c, &work, &middle, &end, k);

    /* d(d, f)/dx = -hidden and d(lambda_1..5)/d(x, lambda_N, lambda_T) = -held: the Schur complement. */
    for (int i = 0; i < INNER; i++) {
        memcpy(a[i], by_end[i + 1] + places, sizeof(a[i]));
        memcpy(hidden[i], by_end[i + 1], places * sizeof(double));
    }
    solve(a, hidden, places);
    for (int i = 0; i < INNER; i++) {
        const double *row = k[places + i];
        for (int j = 0; j < INNER; j++)
            a[i][j] = by_mean[j + 1][places + i];
        memset(held[i], 0, sizeof(held[i]));
        for (int j = 0; j < places; j++)
            held[i][j] = row[j];
        for (int m = 0; m < INNER; m++)
            for (int j = 0; j < places; j++)
                held[i][j] -= row[places + m] * hidden[m][j];
        held[i][places] = by_mean[0][places + i];
    }
    for (int b = 0; b < rule->tangential; b++)
        held[3 + b][places + 1 + b] = length;
    solve(a, held, outer);

    *gap = -sum(nc, n[0][0], pi1.yd);
    residual[places] = *gap;
    double *last = tangent + places * outer;
    memcpy(last, by_end[0], places * sizeof(double));
    for (int i = 0; i < places; i++) {
        double *row = tangent + i * outer;
        memcpy(row, k[i], places * sizeof(double));
        row[places] = by_mean[0][i];
        for (int m = 0; m < INNER; m++) {
            double by_hidden = k[i][places + m], by_held = by_mean[m + 1][i];
            for (int j = 0; j < places; j++)
                row[j] -= by_hidden * hidden[m][j];
            for (int j = 0; j < outer; j++)
                row[j] -= by_held * held[m][j];
            last[i] -= by_end[0][places + m] * hidden[m][i];
        }
        for (int m = 0; m < CONSTRAINTS; m++)
            residual[i] += lambda[m] * by_mean[m][i];
    }
    if (rule->tangential) {
        between(nc, &pi0, &pi1, 0.5, &pi);
        slip_of_pair(rule, &pi, &end, length, hidden, slip_gradient, metric, metric_gradient);
    }
}

/* Arrays that are written come as zeros; those of the slip are not touched without friction. */
void condensed(const Facet *facet, int points, const double *tau, const double *weight, int tangential, long n,
               const double *x0, const double *x1, const double *d0, const double *f0, const double *f1,
               const double *length, const double *multiplier, double *residual, double *tangent, double *gap,
               double *slip_gradient, double *metric, double *metric_gradient)
{
    Rule rule = {*facet, points, tangential, tau, weight};
    int places = 3 * (facet->nc + 1), outer = places + 1 + tangential;
    for (long i = 0; i < n; i++)
        condensed_one(&rule, x0 + i * places, x1 + i * places, d0 + 3 * i, f0 + 2 * i, f1 + 2 * i, length[i],
                      multiplier + i * (1 + tangential), residual + i * outer, tangent + i * outer * outer,
                      gap + i, slip_gradient + 2 * i * outer, metric + 4 * i, metric_gradient + 4 * i * outer);
}
