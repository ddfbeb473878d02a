/* Pieces of a slave's facets that lie over a master's, and points to integrate over there (theory 17.2).
   contact/segments.py calls it; tests/contact/test_segments.py has areas of another kind. */

#include "facets.h"

/* A window cuts off one corner of a polygon at most, and adds two. */
enum { MOST = 10, PER_PIECE = 2 * MOST };

/* Cosine between normals from which on facets do not face each other; distance from an edge, over the
   size of its facet, that is on it; part of a facet that is no piece of it. */
typedef struct {
    double facing, on, nothing;
} Cuts;

typedef struct {
    int count;
    double at[MOST][2];
} Polygon;

static void along(const double *from, const double *to, double *out)
{
    for (int k = 0; k < 3; k++)
        out[k] = to[k] - from[k];
}

/* Normal of a facet, as long as twice its area: the product of its diagonals. */
static void normal_of(int nc, const double *corners, double *out)
{
    double a[3], b[3];
    along(corners, corners + 6, a);
    along(corners + 3, corners + 3 * (nc - 1), b);
    for (int k = 0; k < 3; k++)
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
}

/* Corners in the plane of others through their middle. */
static void flatten(int nc, const double *corners, const double *middle, const double (*axes)[3], int turned, Polygon *out)
{
    double away[3];
    out->count = nc;
    for (int i = 0; i < nc; i++) {
        along(middle, corners + 3 * (turned ? nc - 1 - i : i), away);
        for (int a = 0; a < 2; a++)
            out->at[i][a] = dot(axes[a], away);
    }
}

static double product(const double *a, const double *b) { return a[0] * b[1] - a[1] * b[0]; }

/* Twice the area of the triangle of three points, > 0 if they turn to the left. */
static double turn(const double *a, const double *b, const double *c)
{
    double one[2] = {b[0] - a[0], b[1] - a[1]}, two[2] = {c[0] - a[0], c[1] - a[1]};
    return product(one, two);
}

static double area(const Polygon *p)
{
    double total = 0.0;
    for (int i = 1; i + 1 < p->count; i++)
        total += 0.5 * turn(p->at[0], p->at[i], p->at[i + 1]);
    return total;
}

/* A quadrilateral with a corner that points inwards is two triangles, which both have this corner. */
static int convex_parts(const Polygon *p, Polygon *parts)
{
    int n = p->count, worst = 0;
    double least = INFINITY;
    parts[0] = *p;
    for (int i = 0; i < n; i++) {
        double t = turn(p->at[(i + n - 1) % n], p->at[i], p->at[(i + 1) % n]);
        if (t < least) {
            least = t;
            worst = i;
        }
    }
    if (n < 4 || least >= 0.0)
        return 1;
    for (int part = 0; part < 2; part++) {
        parts[part].count = 3;
        for (int i = 0; i < 3; i++)
            memcpy(parts[part].at[i], p->at[(worst + (i ? i + part : 0)) % n], 2 * sizeof(double));
    }
    return 2;
}

/* The part of a polygon within a convex window, both counter-clockwise: its edges cut one after another
   (Sutherland and Hodgman 1974). */
static void clip(const Cuts *cuts, const Polygon *window, Polygon *p)
{
    int n = window->count;
    double size = 0.0;
    for (int i = 1; i < n; i++)
        for (int a = 0; a < 2; a++)
            size = larger(size, fabs(window->at[i][a] - window->at[0][a]));
    for (int w = 0; w < n && p->count; w++) {
        const double *start = window->at[(w + n - 1) % n], *stop = window->at[w];
        double edge[2] = {stop[0] - start[0], stop[1] - start[1]}, height[MOST];
        double length = sqrt(edge[0] * edge[0] + edge[1] * edge[1]);
        Polygon kept = {0};
        for (int i = 0; i < p->count; i++) {
            double away[2] = {p->at[i][0] - start[0], p->at[i][1] - start[1]};
            height[i] = product(edge, away) / (length > 0.0 ? length : 1.0);
            /* What is on the edge does not cross it by rounding. */
            if (fabs(height[i]) < cuts->on * size)
                height[i] = 0.0;
        }
        for (int i = 0; i < p->count; i++) {
            int next = (i + 1) % p->count;
            if (height[i] >= 0.0)
                memcpy(kept.at[kept.count++], p->at[i], 2 * sizeof(double));
            if (height[i] * height[next] < 0.0) {
                double part = height[i] / (height[i] - height[next]);
                for (int a = 0; a < 2; a++)
                    kept.at[kept.count][a] = p->at[i][a] + part * (p->at[next][a] - p->at[i][a]);
                kept.count++;
            }
        }
        *p = kept;
    }
}

/* The root of a x^2 + b x + c that stays where a vanishes. */
static double root(double a, double b, double c)
{
    double square = sqrt(larger(b * b - 4.0 * a * c, 0.0));
    return -2.0 * c / (b < 0.0 ? b - square : b + square);
}

/* Coordinates in a flat convex facet of a point in its plane. */
static void inverse(const Polygon *facet, const double *point, double *xi)
{
    const double(*x)[2] = (const double(*)[2])facet->at;
    double away[2], s[2], t[2], st[2];
    if (facet->count == 3) {
        double whole = turn(x[0], x[1], x[2]);
        xi[0] = turn(x[0], point, x[2]) / whole;
        xi[1] = turn(x[0], x[1], point) / whole;
        return;
    }
    for (int a = 0; a < 2; a++) {
        away[a] = point[a] - 0.25 * (x[0][a] + x[1][a] + x[2][a] + x[3][a]);
        s[a] = 0.25 * (-x[0][a] + x[1][a] + x[2][a] - x[3][a]);
        t[a] = 0.25 * (-x[0][a] - x[1][a] + x[2][a] + x[3][a]);
        st[a] = 0.25 * (x[0][a] - x[1][a] + x[2][a] - x[3][a]);
    }
    xi[0] = root(-product(s, st), product(away, st) - product(s, t), product(away, t));
    xi[1] = root(-product(t, st), product(away, st) + product(s, t), product(away, s));
}

/* Points and weights of a piece, straight in these coordinates. */
static int rule(const Polygon *p, double (*xi)[2], double *weight)
{
    int n = p->count;
    if (n == 4) { /* exact for degree 3 in each coordinate of the piece */
        const double gauss = sqrt(1.0 / 3.0);
        for (int q = 0; q < 4; q++) {
            double u = q == 0 || q == 3 ? -gauss : gauss, v = q < 2 ? -gauss : gauss, by[2][2];
            double shape[4] = {(1 - u) * (1 - v), (1 + u) * (1 - v), (1 + u) * (1 + v), (1 - u) * (1 + v)};
            for (int a = 0; a < 2; a++) {
                xi[q][a] = 0.0;
                for (int i = 0; i < 4; i++)
                    xi[q][a] += 0.25 * shape[i] * p->at[i][a];
                by[0][a] = 0.25 * ((1 - v) * (p->at[1][a] - p->at[0][a]) + (1 + v) * (p->at[2][a] - p->at[3][a]));
                by[1][a] = 0.25 * ((1 - u) * (p->at[3][a] - p->at[0][a]) + (1 + u) * (p->at[2][a] - p->at[1][a]));
            }
            weight[q] = product(by[0], by[1]);
        }
        return 4;
    }
    if (n == 3) { /* and for degree 2 */
        for (int q = 0; q < 3; q++) {
            for (int a = 0; a < 2; a++)
                xi[q][a] = (p->at[0][a] + p->at[1][a] + p->at[2][a] + 3.0 * p->at[q][a]) / 6.0;
            weight[q] = turn(p->at[0], p->at[1], p->at[2]) / 6.0;
        }
        return 3;
    }
    /* The same with middles of the sides of the triangles around the mean of the corners, wherever these
       are counted from. */
    double middle[2] = {0.0};
    for (int i = 0; i < n; i++)
        for (int a = 0; a < 2; a++)
            middle[a] += p->at[i][a] / n;
    for (int i = 0; i < n; i++) {
        const double *before = p->at[(i + n - 1) % n], *here = p->at[i], *after = p->at[(i + 1) % n];
        double one = turn(middle, here, after) / 6.0;
        for (int a = 0; a < 2; a++) {
            xi[i][a] = 0.5 * (here[a] + after[a]);
            xi[n + i][a] = 0.5 * (middle[a] + here[a]);
        }
        weight[i] = one;
        weight[n + i] = one + turn(middle, before, here) / 6.0;
    }
    return 2 * n;
}

/* Points of the pieces of facets (., nw, 3) over others (., nc, 3) of pairs (n, 2): pair of each, its
   coordinates in the first and its part of their area. Returns their number; those beyond the most are
   not written. */
long segments(const Cuts *cuts, int nw, int nc, long n, const double *own, const double *other, const long *one,
              const long *two, long most, long *pair, double *xi, double *weight)
{
    long number = 0;
    for (long k = 0; k < n; k++) {
        const double *a = own + 3 * nw * one[k], *b = other + 3 * nc * two[k];
        double axes[3][3], way[3], middle[3] = {0.0}, length;
        Polygon window, flat, parts[2];
        normal_of(nw, a, axes[2]);
        normal_of(nc, b, way);
        length = sqrt(dot(axes[2], axes[2]));
        if (!(dot(way, axes[2]) < cuts->facing * sqrt(dot(way, way)) * length))
            continue;
        along(a, a + 3, axes[0]);
        double lift = dot(axes[0], axes[2]) / (length * length);
        for (int i = 0; i < 3; i++) {
            axes[0][i] -= lift * axes[2][i];
            axes[2][i] /= length;
            for (int c = 0; c < nw; c++)
                middle[i] += a[3 * c + i] / nw;
        }
        length = sqrt(dot(axes[0], axes[0]));
        for (int i = 0; i < 3; i++)
            axes[0][i] /= length;
        for (int i = 0; i < 3; i++)
            axes[1][i] = axes[2][(i + 1) % 3] * axes[0][(i + 2) % 3] - axes[2][(i + 2) % 3] * axes[0][(i + 1) % 3];
        flatten(nw, a, middle, (const double(*)[3])axes, 0, &window);
        flatten(nc, b, middle, (const double(*)[3])axes, 1, &flat);
        int count = convex_parts(&flat, parts);
        for (int part = 0; part < count; part++) {
            Polygon *p = &parts[part];
            double at[PER_PIECE][2], each[PER_PIECE], corner[2];
            clip(cuts, &window, p);
            if (p->count < 3 || !(area(p) > cuts->nothing * area(&window)))
                continue;
            for (int i = 0; i < p->count; i++) {
                inverse(&window, p->at[i], corner);
                memcpy(p->at[i], corner, sizeof(corner));
            }
            int points = rule(p, at, each);
            for (int q = 0; q < points && number + points <= most; q++) {
                pair[number + q] = k;
                memcpy(xi + 2 * (number + q), at[q], 2 * sizeof(double));
                weight[number + q] = each[q];
            }
            number += points;
        }
    }
    return number;
}
