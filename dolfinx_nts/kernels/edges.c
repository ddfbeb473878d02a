/* Where sharp edges of two boundaries come closest (theory section 18). */
#include <math.h>

/* Edges: positions of the boundary's points and their ways in the step, the two ends of each edge, the corners of the two facets that meet there,
 * whether these are of a contact's surface, and whether another edge goes straight on from each end. */
typedef struct {
    int nc;
    const double *x, *way;
    const long *ends, *corners;
    const unsigned char *of_surface, *goes_on;
} Edges;

/* Least sine of the angle between two edges, distance from their ends in convective coordinates that belongs to nodes,
 * cosine of the normal with a facet that counts as none, up to which an edge is level with the facet, and up to which what
 * is beyond its rim is not the facet's; distance of a node from the plane of a facet, in lengths of the edges, that counts
 * as none, and how far around a node, in convective coordinates, contact with such a facet is the node's. */
typedef struct {
    double parallel, end, outside, level, steep, flat, by_node;
} EdgeLimits;

static double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* A point of a boundary after a part of its way. */
static void place(const Edges *edges, long point, double part, double *x)
{
    for (int i = 0; i < 3; i++)
        x[i] = edges->x[3 * point + i] + part * edges->way[3 * point + i];
}

/* The middle of an edge, half the way along it, and the unit vectors from there to the middles of its facets. */
static void of_edge(const Edges *edges, long k, double part, double *middle, double *half, double inward[2][3])
{
    double start[3], end[3], corner[3];
    place(edges, edges->ends[2 * k], part, start);
    place(edges, edges->ends[2 * k + 1], part, end);
    for (int i = 0; i < 3; i++) {
        middle[i] = 0.5 * (start[i] + end[i]);
        half[i] = 0.5 * (end[i] - start[i]);
    }
    for (int f = 0; f < 2; f++) {
        const long *corners = edges->corners + (2 * k + f) * edges->nc;
        for (int i = 0; i < 3; i++)
            inward[f][i] = -edges->nc * middle[i];
        for (int c = 0; c < edges->nc; c++) {
            place(edges, corners[c], part, corner);
            for (int i = 0; i < 3; i++)
                inward[f][i] += corner[i];
        }
        double size = sqrt(dot(inward[f], inward[f]));
        for (int i = 0; i < 3; i++)
            inward[f][i] /= size;
    }
}

/* Whether an end of a slave's edge, relative to the middle of a master's edge, is over a facet beside that (1), on it (2),
 * beyond the edge (0), or below the facet (3). `inward` is the way from the edge into the facet, `other` that into the one
 * beside it, and what is nearer than `none` is on it. */
static int over(const double *end, const double *across, const double *inward, const double *other, double none)
{
    double normal[3] = {
        across[1] * inward[2] - across[2] * inward[1],
        across[2] * inward[0] - across[0] * inward[2],
        across[0] * inward[1] - across[1] * inward[0],
    };
    double height = dot(end, normal) / sqrt(dot(normal, normal)), slant = dot(inward, across) / dot(across, across);
    if (dot(normal, other) > 0.0)
        height = -height;
    if (dot(end, inward) <= slant * dot(end, across))
        return 0;
    return height > none ? 1 : height > -none ? 2 : 3;
}

/* Whether the middles of two edges are farther from each other than half their lengths and a reach. */
static int apart(const Edges *slave, const Edges *master, const long *pair, double reach)
{
    const Edges *edges[2] = {slave, master};
    double way[3] = {0.0, 0.0, 0.0};
    for (int k = 0; k < 2; k++) {
        const double *start = edges[k]->x + 3 * edges[k]->ends[2 * pair[k]], *end = edges[k]->x + 3 * edges[k]->ends[2 * pair[k] + 1];
        double half[3];
        for (int i = 0; i < 3; i++) {
            half[i] = 0.5 * (end[i] - start[i]);
            way[i] += (k ? -0.5 : 0.5) * (start[i] + end[i]);
        }
        reach += sqrt(dot(half, half));
    }
    return dot(way, way) > reach * reach;
}

/* Of a pair of edges after a part of the way: the gap along their common normal out of the master, whether they meet
 * between their ends and along normals of both, whether the normal is -b' x a' for +, whether a node of the slave is near,
 * over a facet of the master (1), on it (2), or beyond its edge or below (3, 4), which end is beyond that (1, 2), at
 * which end of the master's edge they meet (1, 2). Of the slave's edge and of the master's, which ends are over facets of
 * the other one or on them (1, 2, 3: both), and which is the nearer to where they meet (1, 2). Ends of edges are their
 * nodes', but on a straight line of the master no node is held. */
static int meets(const Edges *slave, const Edges *master, const EdgeLimits *limits, const long *pair, double part,
                 double *gap, unsigned char *turned, unsigned char *held, unsigned char *beyond, unsigned char *corner,
                 unsigned char *above, unsigned char *nearer)
{
    double a[3], b[3], along[3], across[3], way[3], one[2][3], two[2][3];
    of_edge(slave, pair[0], part, a, along, one);
    of_edge(master, pair[1], part, b, across, two);
    double normal[3] = {
        across[1] * along[2] - across[2] * along[1],
        across[2] * along[0] - across[0] * along[2],
        across[0] * along[1] - across[1] * along[0],
    };
    for (int i = 0; i < 3; i++)
        way[i] = a[i] - b[i];
    double aa = dot(along, along), bb = dot(across, across), ab = dot(along, across);
    double square = dot(normal, normal), size = sqrt(square), left = dot(along, way), right = dot(across, way);
    double s = (ab * right - bb * left) / square, t = (aa * right - ab * left) / square;
    *turned = dot(normal, two[0]) + dot(normal, two[1]) > 0.0;
    for (int i = 0; i < 3; i++)
        normal[i] *= (*turned ? -1.0 : 1.0) / size;
    *gap = dot(way, normal);
    int on = master->goes_on[2 * pair[1] + (t > 0.0)];
    int meet = size > limits->parallel * sqrt(aa * bb) && fabs(s) < 1.0 - limits->end &&
               fabs(t) < 1.0 + (on ? limits->end : -limits->end);
    *corner = on && fabs(t) > 1.0 - limits->end ? 1 + (t > 0.0) : 0;
    double ends[2][3], none = limits->flat * sqrt(aa < bb ? aa : bb);
    for (int i = 0; i < 3; i++) {
        ends[0][i] = way[i] - along[i];
        ends[1][i] = way[i] + along[i];
    }
    *held = *beyond = above[0] = above[1] = 0;
    nearer[0] = s > 0.0 ? 2 : 1;
    nearer[1] = t > 0.0 ? 2 : 1;
    for (int f = 0; f < 2; f++) {
        double cosine = dot(normal, two[f]);
        meet = meet && cosine < limits->outside && -dot(normal, one[f]) < limits->outside;
        if (cosine < -limits->steep || !master->of_surface[2 * pair[1] + f])
            continue;
        int first = over(ends[0], across, two[f], two[1 - f], none), last = over(ends[1], across, two[f], two[1 - f], none);
        int near = s > 0.0 ? last : first;
        above[0] |= (first == 1 || first == 2) | (last == 1 || last == 2) << 1;
        if (cosine > -limits->level && fabs(fabs(s) - 1.0) < limits->by_node) {
            if (near == 1 || near == 2)
                *held = *held < 3 && *held > near ? *held : near;
            else if (*held == 0)
                *held = 3 + (s > 0.0);
        }
        if (first == 0 || last == 0)
            *beyond = first ? 2 : 1;
    }
    for (int i = 0; i < 3; i++) {
        ends[0][i] = -way[i] - across[i];
        ends[1][i] = -way[i] + across[i];
    }
    for (int f = 0; f < 2; f++) {
        if (-dot(normal, one[f]) < -limits->steep || !slave->of_surface[2 * pair[0] + f])
            continue;
        int first = over(ends[0], along, one[f], one[1 - f], none), last = over(ends[1], along, one[f], one[1 - f], none);
        above[1] |= (first == 1 || first == 2) | (last == 1 || last == 2) << 1;
    }
    return meet;
}

/* Of pairs of a slave's and a master's edge the gap and `turned` at the start of the way, the gap at its end, whether they
 * meet at the start, at the end, and where the gap closes on the way, if it does, and at the end what node is near, and
 * which is beyond, and at which end of the master's edge they meet at the start or the end. What is farther apart at the start than the reach does not meet. Of those that meet, which touch, with a
 * gap from -near to limit at the start or one that closes, and which pass each other by more than near; and the numbers of
 * both. An edge also touches and passes whose end slides off a facet of the master over its rim: at the start it does not
 * meet that, and its line may be below it. */
void closest_edges(const Edges *slave, const Edges *master, const EdgeLimits *limits, double reach, double near, double limit,
                   long n, const long *pairs, double *gaps, unsigned char *meet, unsigned char *turned,
                   unsigned char *nodes, unsigned char *touch, long *numbers)
{
    numbers[0] = numbers[1] = 0;
    for (long p = 0; p < n; p++, pairs += 2, gaps += 2, meet += 3, nodes += 3, touch += 2) {
        unsigned char other, before[3], above[2], later[2], nearer[2];
        double none;
        if (apart(slave, master, pairs, reach)) {
            gaps[0] = gaps[1] = INFINITY;
            meet[0] = meet[1] = meet[2] = turned[p] = nodes[0] = nodes[1] = nodes[2] = touch[0] = touch[1] = 0;
            continue;
        }
        meet[0] = meets(slave, master, limits, pairs, 0.0, gaps, turned + p, before, before + 1, before + 2, above, nearer);
        meet[1] = meets(slave, master, limits, pairs, 1.0, gaps + 1, &other, nodes, nodes + 1, nodes + 2, later, nearer);
        nodes[2] = nodes[2] ? nodes[2] : before[2];
        int slides_off = meet[1] && !meet[0] && gaps[1] < -near && ((above[0] & nearer[0]) || (above[1] & nearer[1]));
        meet[2] = gaps[0] > 0.0 && gaps[1] < 0.0 &&
                  meets(slave, master, limits, pairs, gaps[0] / (gaps[0] - gaps[1]), &none, &other, before, before + 1,
                        before + 2, later, nearer);
        touch[0] = ((meet[0] || meet[1]) && gaps[0] > -near && gaps[0] < limit) || meet[2] || slides_off;
        touch[1] = (((meet[1] && fabs(gaps[0]) <= near) || (meet[2] && gaps[0] > near)) && gaps[1] < -near) || slides_off;
        numbers[0] += touch[0];
        numbers[1] += touch[1];
    }
}
