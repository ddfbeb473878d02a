/* Blocks of elements between the same two nodes, summed up. */

/* out[where] += the 3 x 3 blocks of so many nodes in the tangents (n, width, width), whose coordinates
   stand in given columns. `where` (n, nodes, nodes) < 0: nowhere; no row and no column of coordinates
   with numbers < 0 (n, 3 nodes) counts, whatever stands there. */
void node_sums(int nodes, int width, long n, const long *columns, const long *numbers, const long *where,
               const double *tangent, double *out)
{
    for (long e = 0; e < n; e++, numbers += 3 * nodes, tangent += (long)width * width)
        for (int a = 0; a < nodes; a++)
            for (int b = 0; b < nodes; b++) {
                long at = *where++;
                if (at < 0)
                    continue;
                for (int i = 0; i < 3; i++) {
                    if (numbers[3 * a + i] < 0)
                        continue;
                    const double *row = tangent + width * columns[3 * a + i];
                    for (int j = 0; j < 3; j++)
                        if (numbers[3 * b + j] >= 0)
                            out[9 * at + 3 * i + j] += row[columns[3 * b + j]];
                }
            }
}
