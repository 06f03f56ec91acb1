/* A run of Gaussians on its way to the pictures, and what its steps hand on to each other. `_Run` of compositing.py. */
#include "vectors.h"

typedef struct {
    int32_t width, height;                          /* of a picture, pixels */
    int32_t columns, rows, cell_width, cell_height; /* cells in a row, rows of cells in a picture; pixels */
    int32_t band_rows, bands; /* rows of cells in a band, bands in a picture: they depend on the picture alone */
    int32_t cameras, tile_size; /* tile_size: 0 where no square boxes cut */
    int32_t channels, stride;   /* values and the 1; width of the table and of the sums of gradients */
    int64_t each, begin, end;   /* Gaussians of one camera; the run's ranks in `chosen` */
    double below, cap;          /* alpha at or under `below` is skipped, above `cap` cut */
    /* Of all Gaussians, [cameras, each, ...]; `chosen` holds flat indices, near ones first, `values` [v, channels - 1] */
    const int32_t *chosen, *radii;
    const real *means2d, *conics, *determinants, *opacities, *values;
    int32_t *first_row, *high, *first_column, *wide; /* [v]: rows and columns of cells that an ellipse may touch */
    real *logs;                                      /* [v]: log2(opacity) */
    /* An item is what a Gaussian has in one band; items lie band by band, near ones first. */
    int32_t *band_items, *band_strips, *band_cells; /* [cameras * bands + 1]: where each band's begin */
    int32_t *ranks;           /* of each item, in `chosen` */
    int32_t *starts, *places; /* items of Gaussian i: places[starts[i - begin]] and so on */
    real *table;              /* [items, stride]: log2(opacity), x, y, A, B, C (times log2 e), values, 1 */
    int32_t *strip_cells, *strip_wide; /* first cell of a strip, number of its cells */
    int32_t *lists, *list_starts, *list_counts; /* items by cell, near ones first */
    real *colors, *alphas;    /* [cameras, height, width, ...] */
    const real *light_before; /* [cells, pixels] behind the runs before; NULL for the first */
    real *light;              /* behind this one: transmittance, below 0 where a pixel has stopped */
    whole *stop;              /* for each pixel the rank in its cell's list from which on nothing was drawn */
} Run;

#define GEOMETRY 6 /* columns of a row of the table before the values */
#define PULLS 8    /* moments and the two absolute pulls: columns of a row of gradients before the values */

void list_band(const Run *r, int64_t band);
