/* Points of a slave's facets with the element of nts_element.c, summed up in pairs of facets, and in
   their nodes by C (theory 17). tests/twins/surface.py has it in NumPy. */

#include "nts_element.h"

enum { CORNERS = 9, ROWS = 3 * (CORNERS + CONTROL) };

/* The measure's points (n, nc + 1, 3) from corners of slave and master (elements, corners + nc, 3). */
void points_of(int corners, int nc, long n, const long *element, const double *shape, const double *y, double *out)
{
    for (long i = 0; i < n; i++, shape += corners, out += 3 * (nc + 1)) {
        const double *own = y + 3 * (corners + nc) * element[i];
        combine(corners, shape, (const double(*)[3])own, out);
        memcpy(out + 3, own + 3 * corners, 3 * nc * sizeof(double));
    }
}

/* What a point has by its y as what it has by corners of the slave and so many of the master. */
INLINE void spread(int corners, int nc, int others, const double *restrict shape, const double *restrict by_y,
                   double *restrict out)
{
    double total[3] = {0.0};
    for (int i = 0; i < nc; i++)
        for (int k = 0; k < 3; k++)
            total[k] -= by_y[3 * i + k];
    for (int a = 0; a < corners; a++)
        for (int k = 0; k < 3; k++)
            out[3 * a + k] = shape[a] * total[k];
    memcpy(out + 3 * corners, by_y, 3 * others * sizeof(double));
}

/* tangent += the point's stiffness */
INLINE void add_stiffness(int corners, int nc, int others, const double *shape, const Pair *pair, int width,
                          double *tangent)
{
    int size = 3 * (corners + others);
    double row[ROWS], total[3][ROWS] = {{0.0}};
    for (int i = 0; i < 3 * nc; i++) {
        spread(corners, nc, others, shape, pair->stiffness[i], row);
        if (i < 3 * others)
            axpy(size, 1.0, row, tangent + (3 * corners + i) * width);
        axpy(size, -1.0, row, total[i % 3]);
    }
    for (int a = 0; a < corners; a++)
        for (int k = 0; k < 3; k++)
            axpy(size, shape[a], total[k], tangent + (3 * a + k) * width);
}

/* As in nts_element.c. */
static void four_on_four(int corners, int nc, int others, const double *shape, const Pair *pair, int width, double *tangent)
{
    (void)corners, (void)nc, (void)others;
    add_stiffness(4, 4, 4, shape, pair, width, tangent);
}

static void any_on_any(int corners, int nc, int others, const double *shape, const Pair *pair, int width, double *tangent)
{
    add_stiffness(corners, nc, others, shape, pair, width, tangent);
}

/* What a point has of friction: directions a_a over the facet's size halfway, and their change by the
   slip and by the master's control points. */
typedef struct {
    double along[2][3], by_slip[2][2][3], by_control[2][CONTROL], slip[2];
} Middle;

static void middle_of(const Rule *rule, const Place *p, double theta, double length, Middle *out)
{
    int nc = rule->facet.nc;
    double f[2], y[CONTROL][3];
    Shape n;
    Sums s;
    for (int b = 0; b < 2; b++) {
        f[b] = p->f[0][b] + theta * (p->f[1][b] - p->f[0][b]);
        out->slip[b] = length * (p->f[1][b] - p->f[0][b]);
    }
    for (int i = 0; i < nc; i++)
        for (int k = 0; k < 3; k++)
            y[i][k] = p->y[0][i][k] + theta * (p->y[1][i][k] - p->y[0][i][k]);
    shape(&rule->facet, f, 2, n);
    sums(nc, n, y, s);
    for (int a = 0; a < 2; a++) {
        for (int k = 0; k < 3; k++) {
            out->along[a][k] = s[1 + a][k] / length;
            for (int b = 0; b < 2; b++)
                out->by_slip[a][b][k] = theta * s[3 + a + b][k] / (length * length);
        }
        for (int i = 0; i < nc; i++)
            out->by_control[a][i] = theta * n[1][a][i] / length;
    }
}

/* Derivative by y of a vector in space times each direction a_a. */
static void turns_of(int nc, const Middle *m, const double (*slip)[WIDTH], const double *v, double (*out)[WIDTH])
{
    for (int a = 0; a < 2; a++) {
        memset(out[a], 0, 3 * nc * sizeof(double));
        outer(nc, 1.0, m->by_control[a], v, out[a]);
        for (int b = 0; b < 2; b++)
            axpy(3 * nc, dot(m->by_slip[a][b], v), slip[b], out[a]);
    }
}

/* What a point gives: its pair, with the columns of lambda_T and the gradient of the slip, and that of
   the gap. */
typedef struct {
    Pair pair;
    double rise[WIDTH], slip[2][WIDTH];
} Point;

/* From the arrays of another rule, which have x_s first. */
static void take(int nc, int tangential, const double *residual, const double *tangent, const double *slip, Point *out)
{
    int count = 3 * nc, places = count + 3, size = places + 1 + tangential;
    memcpy(out->pair.force, residual + 3, count * sizeof(double));
    out->pair.gap = residual[places];
    memcpy(out->rise, tangent + places * size + 3, count * sizeof(double));
    for (int i = 0; i < count; i++) {
        const double *row = tangent + (3 + i) * size;
        memcpy(out->pair.stiffness[i], row + 3, count * sizeof(double));
        out->pair.by_normal[i] = row[places];
        for (int b = 0; b < tangential; b++) {
            out->pair.by_slip[b][i] = row[places + 1 + b];
            out->slip[b][i] = slip[b * size + 3 + i];
        }
    }
}

static void make(const Rule *rule, Place *p, double normal, const double *t, double length, Point *out)
{
    int nc = rule->facet.nc;
    double scaled[2] = {length * t[0], length * t[1]};
    pair_of(rule, p, normal, scaled, &out->pair);
    memset(out->rise, 0, 3 * nc * sizeof(double));
    outer(nc, -1.0, out->pair.n, p->d[1], out->rise);
    for (int b = 0; b < rule->tangential; b++)
        for (int i = 0; i < 3 * nc; i++) {
            out->pair.by_slip[b][i] *= length;
            out->slip[b][i] = length * out->pair.foot[b][i];
        }
}

/* Where what points have is summed up: slaves at the corners of the facet, < 0 where there is none, with
   shares C and shape functions of its corners; control points, others of which have rows. */
typedef struct {
    int corners, nc, others, tangential;
    const long *slot;
    const double *shape, *share, *multiplier, *directions;
    double *residual, *tangent, *force, *gap, *slip, *pulls;
} Total;

/* The normal multiplier and the friction of a point. */
static double carried(const Total *to, double *pull)
{
    int each = 1 + to->tangential;
    double normal = 0.0;
    memset(pull, 0, 3 * sizeof(double));
    for (int c = 0; c < to->corners; c++) {
        long slave = to->slot[c];
        if (slave < 0)
            continue;
        normal += to->share[c] * to->multiplier[slave * each];
        for (int m = 0; m < to->tangential; m++)
            axpy(3, to->share[c] * to->multiplier[slave * each + 1 + m], to->directions + 3 * (2 * slave + m), pull);
    }
    return normal;
}

/* Add what a point has that carries so much. */
static void sum_up(const Total *to, Point *point, const Middle *middle, double normal, const double *pull)
{
    int nc = to->nc, count = 3 * nc, corners = to->corners, others = to->others, size = 3 * (corners + others),
        each = 1 + to->tangential, width = size + corners * each;
    double row[ROWS], column[ROWS], change[2][WIDTH], t[2] = {0.0}, *k = to->tangent;
    Pair *pair = &point->pair;
    for (int a = 0; a < to->tangential; a++)
        t[a] = dot(middle->along[a], pull);
    if (to->tangential)
        turns_of(nc, middle, (const double(*)[WIDTH])point->slip, pull, change);
    for (int a = 0; a < to->tangential; a++)
        for (int j = 0; j < count; j++)
            axpy(count, pair->by_slip[a][j], change[a], pair->stiffness[j]);
    spread(corners, nc, others, to->shape, pair->force, row);
    axpy(size, 1.0, row, to->residual);
    memset(to->force, 0, 3 * sizeof(double));
    memcpy(to->force + 3, pair->force, 3 * others * sizeof(double));
    for (int j = 0; j < count; j++)
        to->force[j % 3] -= pair->force[j];
    if (normal != 0.0 || t[0] != 0.0 || t[1] != 0.0)
        (corners == 4 && others == 4 ? four_on_four : any_on_any)(corners, nc, others, to->shape, pair, width, k);
    for (int m = 0; m < each; m++)
        for (int c = 0; c < corners; c++) {
            long slave = to->slot[c];
            int at = size + c * each + m;
            if (slave < 0)
                continue;
            if (m) {
                const double *v = to->directions + 3 * (2 * slave + m - 1);
                double by_y[WIDTH] = {0.0}, by_own[WIDTH] = {0.0};
                turns_of(nc, middle, (const double(*)[WIDTH])point->slip, v, change);
                for (int a = 0; a < 2; a++) {
                    axpy(count, dot(middle->along[a], v), pair->by_slip[a], by_own);
                    axpy(count, dot(middle->along[a], v), point->slip[a], by_y);
                    axpy(count, middle->slip[a], change[a], by_y);
                }
                spread(corners, nc, others, to->shape, by_y, row);
                spread(corners, nc, others, to->shape, by_own, column);
            } else if (c == 0 || to->slot[c - 1] < 0) {
                spread(corners, nc, others, to->shape, point->rise, row);
                spread(corners, nc, others, to->shape, pair->by_normal, column);
            }
            axpy(size, to->share[c], row, k + at * width);
            for (int j = 0; j < size; j++)
                k[j * width + at] += to->share[c] * column[j];
            for (int j = 0; j < 3 * corners; j++)
                to->pulls[3 * slave + j % 3] += to->share[c] * to->multiplier[slave * each + m] * column[j];
        }
    for (int c = 0; c < corners; c++) {
        if (to->slot[c] < 0)
            continue;
        to->gap[to->slot[c]] += to->share[c] * pair->gap;
        for (int a = 0; a < to->tangential; a++)
            axpy(3, to->share[c] * middle->slip[a], middle->along[a], to->slip + 3 * to->slot[c]);
    }
}

/* Points (n,) in elements, in ascending order; slaves at their corners, < 0 where there is none, with
   shares C, shape functions (n, corners). Of slaves lambda_N, or lambda_N and forces along two directions
   (slaves, 2, 3). Other rules than the mean value give residual, tangent and gradient of the slip of points
   by own (n, ..), else these are none. What is written comes as zeros: residual and tangent of elements,
   rows of multipliers at corners those of the slaves' gap and slips; force of the points (n, nc + 1, 3);
   gap, slip (3) and minus the force (3) of slaves. */
void over_surface(const Facet *facet, int points, const double *tau, const double *weight, int tangential,
                  double theta, int corners, long n, const long *element, const long *slot, const double *shapes,
                  const double *shares, const double *x0, const double *x1, const double *d0, const double *f0,
                  const double *f1, const double *length, const double *multiplier, const double *directions,
                  const double *own_residual, const double *own_tangent, const double *own_slip, double *residual,
                  double *tangent, double *force, double *gap, double *slip, double *pulls)
{
    Rule rule = {*facet, points, tangential, tau, weight};
    int nc = facet->nc, places = 3 * nc + 3, width = 3 * (corners + nc) + corners * (1 + tangential),
        own = places + 1 + tangential;
    Total to = {corners, nc, nc, tangential, slot, shapes, shares, multiplier, directions, 0, 0, force, gap, slip, pulls};
    Place p;
    Point point;
    Middle middle;
    for (long i = 0; i < n; i++, to.slot += corners, to.shape += corners, to.share += corners, to.force += places) {
        double pull[3], t[2] = {0.0}, normal = carried(&to, pull);
        to.residual = residual + element[i] * width, to.tangent = tangent + element[i] * width * width;
        place_of(nc, x0 + i * places, x1 + i * places, d0 + 3 * i, f0 + 2 * i, f1 + 2 * i, &p);
        if (tangential)
            middle_of(&rule, &p, theta, length[i], &middle);
        for (int a = 0; a < tangential; a++)
            t[a] = dot(middle.along[a], pull);
        if (own_tangent)
            take(nc, tangential, own_residual + i * own, own_tangent + i * own * own, own_slip + 2 * i * own, &point);
        else
            make(&rule, &p, normal, t, length[i], &point);
        sum_up(&to, &point, &middle, normal, pull);
    }
}

/* The same of points and an obstacle, by residual, tangent and slip of `obstacle`, slip along directions that do
   not turn (n, 2, 3): the obstacle is a control point without rows, with minus what the slave has. */
void over_obstacle(int tangential, int corners, long n, const long *element, const long *slot, const double *shapes,
                   const double *shares, const double *multiplier, const double *directions, const double *along,
                   const double *own_residual, const double *own_tangent, const double *own_value,
                   const double *own_slip, double *residual, double *tangent, double *force, double *gap,
                   double *slip, double *pulls)
{
    int each = 1 + tangential, own = 3 + each, width = corners * (3 + each);
    Total to = {corners, 1, 0, tangential, slot, shapes, shares, multiplier, directions, 0, 0, force, gap, slip, pulls};
    for (long i = 0; i < n; i++, to.slot += corners, to.shape += corners, to.share += corners, to.force += 3) {
        const double *r = own_residual + i * own, *k = own_tangent + i * own * own;
        double pull[3], normal = carried(&to, pull);
        Middle middle = {{{0.0}}};
        Point point;
        to.residual = residual + element[i] * width, to.tangent = tangent + element[i] * width * width;
        point.pair.gap = r[3];
        for (int a = 0; a < 3; a++) {
            point.pair.force[a] = -r[a];
            point.pair.by_normal[a] = -k[a * own + 3];
            point.rise[a] = -k[3 * own + a];
            memcpy(point.pair.stiffness[a], k + a * own, 3 * sizeof(double));
            for (int b = 0; b < tangential; b++) {
                point.pair.by_slip[b][a] = -k[a * own + 4 + b];
                point.slip[b][a] = -own_slip[(2 * i + b) * own + a];
            }
        }
        if (tangential) {
            memcpy(middle.along, along + 6 * i, sizeof middle.along);
            memcpy(middle.slip, own_value + 2 * i, sizeof middle.slip);
        }
        sum_up(&to, &point, &middle, normal, pull);
    }
}

/* Write the laws of slaves, derivatives (slaves, each, 3 + each) of their rows by gap, two slips and own
   multipliers, into elements whose rows of multipliers are gap and slips; multipliers are over scale. Each
   of so many elements of a slave has a part of its own. */
void law_of_sums(int corners, int each, int size, long n, const long *slot, const double *scale,
                 const double *slopes, const long *elements, double *tangent)
{
    int width = size + corners * each, wide = 3 + each;
    for (long i = 0; i < n; i++, slot += corners, tangent += width * width)
        for (int c = 0; c < corners; c++) {
            int at = size + c * each;
            if (slot[c] < 0)
                continue;
            const double *by = slopes + slot[c] * each * wide;
            for (int j = 0; j < size; j++) {
                double was[3], *column = tangent + at * width + j, *row = tangent + j * width + at;
                for (int m = 0; m < each; m++) {
                    was[m] = column[m * width];
                    row[m] *= scale[slot[c]];
                }
                for (int m = 0; m < each; m++) {
                    column[m * width] = 0.0;
                    for (int k = 0; k < each; k++)
                        column[m * width] += by[m * wide + k] * was[k];
                }
            }
            for (int m = 0; m < each; m++)
                for (int k = 0; k < each; k++)
                    tangent[(at + m) * width + at + k] = by[m * wide + 3 + k] / elements[slot[c]];
        }
}
