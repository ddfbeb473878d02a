/* Projections onto facets and closest points of them.

   `project` leaves to kernels/facets.py, and `closest_facets` to contact/search.py, what they do not do.
   tests/kernels/test_compiled.py compares the first with that. */

#include <float.h>
#include <stdlib.h>

#include "facets.h"

enum { MOST_STEPS = 20, MOST_BISECTIONS = 120 };

/* Newton's last step, how it grows with the distance of far points, and the squared sine of an angle
   that is rounding only. */
typedef struct {
    double last_step, far_step, collinear;
} Limits;

void shape(const Facet *facet, const double *xi, int highest, Shape n)
{
    int nc = facet->nc, degree = facet->degree, terms = (degree + 1) * (degree + 1);
    double power[(DEGREE + 1) * (DEGREE + 1)], s = 1.0;
    for (int i = 0, k = 0; i <= degree; i++, s *= xi[0]) {
        double st = s;
        for (int j = 0; j <= degree; j++, st *= xi[1])
            power[k++] = st;
    }
    for (int order = 0; order <= highest; order++)
        for (int b = 0; b <= order; b++) {
            const double *c = facet->coefficients + (order * 4 + b) * terms * nc;
            double *out = n[order][b];
            memset(out, 0, nc * sizeof(double));
            for (int p = 0; p <= degree - order + b; p++) {
                int last = facet->together ? degree - order - p : degree - b;
                for (int k = p * (degree + 1), q = 0; q <= last; q++, k++)
                    for (int i = 0; i < nc; i++)
                        out[i] += c[k * nc + i] * power[k];
            }
        }
}

/* First corner relative to the point, and corners relative to it. */
static void local(int nc, const double *point, const double *corners, double *start, double (*spans)[3])
{
    for (int k = 0; k < 3; k++) {
        start[k] = corners[k] - point[k];
        for (int i = 0; i < nc; i++)
            spans[i][k] = corners[3 * i + k] - corners[k];
    }
}

/* From the point to that of the facet at xi. */
static void offset_at(const double *start, int nc, const double (*spans)[3], const double *n, double *offset)
{
    combine(nc, n, spans, offset);
    for (int k = 0; k < 3; k++)
        offset[k] += start[k];
}

/* ---- orthogonal projection by plain steps of Newton's method, which must come nearer; xi is start
   and result, or as it was where 0 is returned */
INLINE int newton_of(int nc, const Facet *facet, const Limits *limits, const double *start,
                     const double (*spans)[3], double *xi)
{
    double offset[3], step[2], at[2] = {xi[0], xi[1]};
    double extent = 0.0, far = 0.0, slope = 0.0, before = 0.0, largest = 0.0;
    for (int k = 0; k < 3; k++) {
        far = larger(far, fabs(start[k]));
        for (int i = 0; i < nc; i++)
            extent = larger(extent, fabs(spans[i][k]));
    }
    double last_step = limits->last_step + limits->far_step * far / extent;
    for (int iteration = 0; iteration < MOST_STEPS; iteration++) {
        Shape n;
        double t[2][3], g[2], h[3], height[CONTROL];
        shape(facet, at, 2, n);
        offset_at(start, nc, spans, n[0][0], offset);
        double square = dot(offset, offset);
        /* Smaller steps come nearer by what rounding hides. */
        if (largest > 1e-5 && !(0.5 * (square - before) <= 1e-4 * slope))
            return 0;
        before = square;
        for (int a = 0; a < 2; a++) {
            combine(nc, n[1][a], spans, t[a]);
            g[a] = dot(t[a], offset);
        }
        for (int i = 0; i < nc; i++)
            height[i] = dot(spans[i], offset);
        for (int k = 0; k < 3; k++)
            h[k] = dot(t[k == 2], t[k > 0]) + sum(nc, n[2][k], height);
        double determinant = h[0] * h[2] - h[1] * h[1];
        if (!(h[0] > 0.0 && h[2] > 0.0 && determinant > 1e-6 * h[0] * h[2]))
            return 0;
        step[0] = -(h[2] * g[0] - h[1] * g[1]) / determinant;
        step[1] = -(h[0] * g[1] - h[1] * g[0]) / determinant;
        slope = g[0] * step[0] + g[1] * step[1];
        at[0] += step[0];
        at[1] += step[1];
        largest = larger(fabs(step[0]), fabs(step[1]));
        if (fabs(step[0]) <= last_step && fabs(step[1]) <= last_step) {
            xi[0] = at[0];
            xi[1] = at[1];
            return 1;
        }
    }
    return 0;
}

static int newton(const Facet *facet, const Limits *limits, const double *start, const double (*spans)[3],
                  double *xi)
{
    if (facet->nc == 4)
        return newton_of(4, facet, limits, start, spans, xi);
    return newton_of(facet->nc, facet, limits, start, spans, xi);
}

/* Points (n, 3), corners (n, nc, 3); xi (n, 2) is start and result; which are done (n,). */
void project(const Facet *facet, const Limits *limits, long n, const double *points, const double *corners,
             double *xi, unsigned char *done)
{
    for (long i = 0; i < n; i++) {
        double start[3], spans[CONTROL][3];
        local(facet->nc, points + 3 * i, corners + 3 * i * facet->nc, start, spans);
        done[i] = newton(facet, limits, start, spans, xi + 2 * i);
    }
}

/* ---- closest points of bounded facets */
static const double TRIANGLE[3][2] = {{0, 0}, {1, 0}, {0, 1}};
static const double SQUARE[4][2] = {{-1, -1}, {1, -1}, {1, 1}, {-1, 1}};

/* Squared distance from the closest point of the facet's boundary, and where that is. */
static double closest_edge(int nc, const double *start, const double (*spans)[3], double *xi)
{
    const double(*corner)[2] = nc == 3 ? TRIANGLE : SQUARE;
    double least = INFINITY;
    for (int i = 0; i < nc; i++) {
        int j = (i + 1) % nc;
        double y[3], edge[3], foot[3], tau = 0.0;
        for (int k = 0; k < 3; k++) {
            y[k] = start[k] + spans[i][k];
            edge[k] = spans[j][k] - spans[i][k];
        }
        double square = dot(edge, edge);
        if (square > 0.0)
            tau = smaller(larger(-dot(y, edge) / square, 0.0), 1.0);
        for (int k = 0; k < 3; k++)
            foot[k] = y[k] + tau * edge[k];
        if (dot(foot, foot) < least) {
            least = dot(foot, foot);
            for (int a = 0; a < 2; a++)
                xi[a] = (1.0 - tau) * corner[i][a] + tau * corner[j][a];
        }
    }
    return least;
}

static void closest_of_triangle(const double *start, const double (*spans)[3], double collinear, double *xi)
{
    const double *a = spans[1], *b = spans[2];
    double m11 = dot(a, a), m12 = dot(a, b), m22 = dot(b, b);
    double g1 = dot(a, start), g2 = dot(b, start), determinant = m11 * m22 - m12 * m12;
    xi[0] = -(m22 * g1 - m12 * g2) / determinant;
    xi[1] = -(m11 * g2 - m12 * g1) / determinant;
    int inside = xi[0] >= 0.0 && xi[1] >= 0.0 && xi[0] + xi[1] <= 1.0;
    if (determinant <= collinear * m11 * m22 || !inside)
        closest_edge(3, start, spans, xi);
}

/* Products of the vectors of xbar - x = c_0 + c_1 s + c_2 t + c_3 s t. */
static void gram(const double *start, const double (*spans)[3], double (*g)[4])
{
    double c[4][3];
    for (int k = 0; k < 3; k++) {
        for (int m = 0; m < 4; m++)
            c[m][k] = 0.0;
        for (int i = 0; i < 4; i++) {
            double s = SQUARE[i][0], t = SQUARE[i][1], span = 0.25 * spans[i][k];
            c[0][k] += span;
            c[1][k] += s * span;
            c[2][k] += t * span;
            c[3][k] += s * t * span;
        }
        c[0][k] += start[k];
    }
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++)
            g[i][j] = dot(c[i], c[j]);
}

/* Minimum of a + 2 b t + c t^2 over [-1, 1], c >= 0. */
static double least_of(double a, double b, double c)
{
    double t = fabs(b) < c ? -b / c : (b < 0.0) - (b > 0.0);
    return a + t * (2.0 * b + c * t);
}

/* Whether the squared distance is certainly convex over the reference square. */
static int is_convex(double (*g)[4])
{
    double in_s = least_of(g[1][1], g[1][3], g[3][3]), in_t = least_of(g[2][2], g[2][3], g[3][3]);
    double largest = 0.0;
    for (int i = 0; i < 4; i++) {
        double s = SQUARE[i][0], t = SQUARE[i][1];
        double mixed = g[0][3] + g[1][2] + 2.0 * (g[1][3] * s + g[2][3] * t + g[3][3] * s * t);
        largest = larger(largest, fabs(mixed));
    }
    return in_s > 0.0 && largest * largest < in_s * in_t;
}

/* s that is best at this t, and the first and second derivative by t of half the least square */
static double slope_at(double (*g)[4], double t, double *slope, double *curvature)
{
    double cross = g[0][3] + g[1][2], square = g[1][1] + t * (2.0 * g[1][3] + t * g[3][3]);
    double raw = -(g[0][1] + t * (cross + t * g[2][3])) / square, s = smaller(larger(raw, -1.0), 1.0);
    double in_t = g[2][2] + s * (2.0 * g[2][3] + s * g[3][3]);
    double mixed = cross + 2.0 * (g[1][3] * s + t * (g[2][3] + g[3][3] * s));
    *slope = g[0][2] + s * (cross + g[1][3] * s) + t * in_t;
    *curvature = in_t - (raw == s ? mixed * mixed / square : 0.0);
    return s;
}

static void closest_convex(double (*g)[4], double last_step, double *xi)
{
    double low = -1.0, high = 1.0, t = 0.0, slope, curvature;
    slope_at(g, low, &slope, &curvature);
    if (slope >= 0.0)
        t = low;
    slope_at(g, high, &slope, &curvature);
    if (slope <= 0.0)
        t = high;
    for (int open = t == 0.0, k = 0; open && k < MOST_BISECTIONS; k++) {
        double old = t;
        slope_at(g, old, &slope, &curvature);
        if (slope < 0.0)
            low = old;
        else
            high = old;
        t = old - slope / curvature;
        open = high - low > 4.0 * DBL_EPSILON;
        if (!(t >= low && t <= high))
            t = 0.5 * (low + high);
        else if (fabs(t - old) <= last_step)
            open = 0;
    }
    xi[0] = slope_at(g, t, &slope, &curvature);
    xi[1] = t;
}

static double polynomial(int k, const double *c, double t)
{
    double value = 0.0;
    for (int i = k - 1; i >= 0; i--)
        value = value * t + c[i];
    return value;
}

/* out += factor a b, of ka and kb coefficients */
static void multiply(int ka, const double *a, int kb, const double *b, double factor, double *out)
{
    for (int i = 0; i < ka; i++)
        for (int j = 0; j < kb; j++)
            out[i + j] += factor * a[i] * b[j];
}

/* The k - 1 points of [-1, 1], in ascending order, with all sign changes of a polynomial of k
   coefficients among them: between the roots of its derivative it is monotone. */
static void sign_changes(int k, const double *c, double *points)
{
    double node[8] = {-1.0}, slope[5];
    for (int i = 1; i < k; i++)
        slope[i - 1] = i * c[i];
    if (k > 2)
        sign_changes(k - 1, slope, node + 1);
    node[k - 1] = 1.0;
    for (int i = 0; i < k - 1; i++) {
        double low = node[i], high = node[i + 1];
        int negative = polynomial(k, c, low) < 0.0;
        while (high - low > 4.0 * DBL_EPSILON) {
            double middle = 0.5 * (low + high);
            if ((polynomial(k, c, middle) < 0.0) == negative)
                low = middle;
            else
                high = middle;
        }
        points[i] = 0.5 * (low + high);
    }
}

/* Any quadrilateral: the boundary, and the roots of the quintic, brought to round-off unless the facet is
   curved there around the point, which leaves the place open, but not the distance. */
static void closest_warped(const Facet *facet, const Limits *limits, const double *start,
                           const double (*spans)[3], double *xi)
{
    double unit = 0.0, near[3], sides[4][3], g[4][4], quintic[6] = {0.0}, t[5], offset[3], polished[2];
    for (int k = 0; k < 3; k++) {
        unit = larger(unit, fabs(start[k]));
        for (int i = 0; i < 4; i++)
            unit = larger(unit, fabs(spans[i][k]));
    }
    unit = unit > 0.0 ? unit : 1.0;
    for (int k = 0; k < 3; k++) {
        near[k] = start[k] / unit;
        for (int i = 0; i < 4; i++)
            sides[i][k] = spans[i][k] / unit;
    }
    gram(near, sides, g);
    double slope_p[2] = {2.0 * g[0][2], 2.0 * g[2][2]};
    double q[3] = {g[0][1], g[0][3] + g[1][2], g[2][3]}, slope_q[2] = {q[1], 2.0 * q[2]};
    double b[3] = {g[1][1], 2.0 * g[1][3], g[3][3]}, slope_b[2] = {b[1], 2.0 * b[2]};
    double pb[4] = {0.0}, qq[4] = {0.0}, square[5] = {0.0};
    multiply(2, slope_p, 3, b, 1.0, pb);
    multiply(4, pb, 3, b, 1.0, quintic);
    multiply(3, q, 2, slope_q, 1.0, qq);
    multiply(4, qq, 3, b, -2.0, quintic);
    multiply(3, q, 3, q, 1.0, square);
    multiply(5, square, 2, slope_b, 1.0, quintic);
    sign_changes(6, quintic, t);
    Shape n;
    double least = closest_edge(4, start, spans, xi);
    for (int i = 0; i < 5; i++) {
        double over = polynomial(3, b, t[i]), at[2] = {0.0, t[i]};
        if (over > 0.0)
            at[0] = smaller(larger(-polynomial(3, q, t[i]) / over, -1.0), 1.0);
        shape(facet, at, 0, n);
        offset_at(start, 4, spans, n[0][0], offset);
        if (dot(offset, offset) < least) {
            least = dot(offset, offset);
            memcpy(xi, at, sizeof(at));
        }
    }
    if (!(fabs(xi[0]) < 1.0 && fabs(xi[1]) < 1.0))
        return;
    memcpy(polished, xi, sizeof(polished));
    newton(facet, limits, start, spans, polished);
    if (fabs(polished[0]) <= 1.0 && fabs(polished[1]) <= 1.0)
        memcpy(xi, polished, sizeof(polished));
}

/* Coordinates of the closest point; its distance is returned. */
static double closest_of_pair(const Facet *facet, const Limits *limits, const double *point,
                              const double *corners, double *xi)
{
    double start[3], spans[CONTROL][3], g[4][4], offset[3];
    int nc = facet->nc;
    Shape n;
    local(nc, point, corners, start, spans);
    if (nc == 3)
        closest_of_triangle(start, spans, limits->collinear, xi);
    else {
        gram(start, spans, g);
        if (is_convex(g))
            closest_convex(g, limits->last_step, xi);
        else
            closest_warped(facet, limits, start, spans, xi);
    }
    shape(facet, xi, 0, n);
    offset_at(start, nc, spans, n[0][0], offset);
    return sqrt(dot(offset, offset));
}

/* Points (n, 3), corners (n, nc, 3); coordinates (n, 2) and distances (n,). */
void closest_point(const Facet *facet, const Limits *limits, long n, const double *points, const double *corners,
                   double *xi, double *distance)
{
    for (long i = 0; i < n; i++)
        distance[i] = closest_of_pair(facet, limits, points + 3 * i, corners + 3 * i * facet->nc, xi + 2 * i);
}

static double square_from_box(const double *point, const double *box)
{
    double square = 0.0;
    for (int k = 0; k < 3; k++) {
        double outside = larger(larger(box[k] - point[k], point[k] - box[3 + k]), 0.0);
        square += outside * outside;
    }
    return square;
}

/* Of points (n, 3) the closest of the facets (m, nc, 3) of these sizes (m,) within a limit (n,): among
   those that rounding does not tell apart the first. Facet, coordinates and distance stay as they are
   where there is none. 0 is returned without memory. */
int closest_facets(const Facet *facet, const Limits *limits, long n, const double *points, const double *limit,
                    long m, const double *corners, const double *sizes, double rounding, long *found, double *xi,
                   double *distance)
{
    double *box = malloc(6 * m * sizeof(double)), *near = malloc(m * sizeof(double));
    double *far = malloc(m * sizeof(double)), *at = malloc(2 * m * sizeof(double)), largest = 0.0;
    int enough = box && near && far && at;
    if (!enough)
        n = 0;
    for (long j = 0; n && j < m; j++) {
        const double *c = corners + 3 * j * facet->nc;
        for (int k = 0; k < 3; k++) {
            double *low = box + 6 * j + k, *high = low + 3;
            *low = *high = c[k];
            for (int i = 1; i < facet->nc; i++) {
                *low = smaller(*low, c[3 * i + k]);
                *high = larger(*high, c[3 * i + k]);
            }
        }
        largest = larger(largest, sizes[j]);
    }
    for (long i = 0; i < n; i++) {
        const double *x = points + 3 * i;
        double magnitude = larger(larger(fabs(x[0]), fabs(x[1])), fabs(x[2])), least = limit[i];
        long first = 0;
        for (long j = 0; j < m; j++) {
            near[j] = square_from_box(x, box + 6 * j);
            if (near[j] < near[first])
                first = j;
        }
        /* The facet of the nearest box first, which leaves few others. */
        for (long k = 0; k < m; k++) {
            long j = k == 0 ? first : k <= first ? k - 1 : k;
            far[j] = INFINITY;
            double bound = least + 8.0 * rounding * (magnitude + 2.0 * largest + least);
            if (near[j] <= bound * bound)
                far[j] = closest_of_pair(facet, limits, x, corners + 3 * j * facet->nc, at + 2 * j);
            least = smaller(least, far[j]);
        }
        for (long j = 0; j < m; j++) {
            double tie = least + rounding * (magnitude + sizes[j] + far[j]);
            if (far[j] < INFINITY && far[j] <= smaller(limit[i], tie)) {
                found[i] = j;
                distance[i] = far[j];
                memcpy(xi + 2 * i, at + 2 * j, 2 * sizeof(double));
                break;
            }
        }
    }
    free(box);
    free(near);
    free(far);
    free(at);
    return enough;
}
