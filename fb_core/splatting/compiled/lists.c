/* Which Gaussian touches which cell: the same ellipses as in ../tiles/cells.py, band by band.
 *
 * A band is some rows of cells of one picture. Bands share nothing, so that each goes to a thread of its own, and what
 * Gaussians gain in them is added up band by band: any number of threads gives the same bits.
 */
#ifndef __clang__
#pragma GCC optimize("tree-loop-vectorize", "no-tree-slp-vectorize", "vect-cost-model=dynamic")
#endif
#include "run.h"

#define LOG2_E ((real)1.4426950408889634)
#define LOG2_255 ((real)7.9943534368588578)
#define MARGIN ((real)0.01) /* pixels: rounding must not lose a cell */

#define BLOCK 64           /* strips that are measured together */
#define EACH for (int i = 0; i < BLOCK; i++)

typedef struct { real x, y, A, B, C, determinant, reach; } Ellipse;

ALWAYS real clamp(real x, real low, real high) { return x > low ? (x < high ? x : high) : low; } /* NaN: low */
ALWAYS real larger(real a, real b) { return a > b ? a : b; }
ALWAYS real smaller(real a, real b) { return a < b ? a : b; }

/* First cell with a pixel centre from the coordinate on, and the one after the last up to it. */
ALWAYS real cell_from(real at, real size, real limit) { return clamp(FLOOR(CEIL(at - HALF) / size), 0, limit); }
ALWAYS real cell_to(real at, real size, real limit) { return clamp(FLOOR(FLOOR(at - HALF) / size) + 1, 0, limit); }

ALWAYS Ellipse ellipse_of(const Run *r, int64_t g, real logarithm) {
    Ellipse e = {.x = r->means2d[2 * g], .y = r->means2d[2 * g + 1], .A = r->conics[3 * g], .B = r->conics[3 * g + 1],
        .C = r->conics[3 * g + 2], .determinant = r->determinants[g]};
    e.reach = (logarithm + LOG2_255) * (real)(0.69314718055994531 * 2 * 1.0005) + (real)1e-3;
    return e;
}

/* Rows and columns of cells of the Gaussians with ranks from first to last. */
void fb_spans(const Run *r, int64_t first, int64_t last) {
    const real width = r->cell_width, height = r->cell_height, scale = r->tile_size ? (real)(1.0 / r->tile_size) : 0;
    const int per_row = r->tile_size / r->cell_width, per_column = r->tile_size / r->cell_height;
    for (int64_t i = first; i < last; i++) {
        const int64_t g = r->chosen[i];
        const real opacity = r->opacities[g], logarithm = BYTES == 8 ? log2(opacity) : log2f((float)opacity);
        const Ellipse e = ellipse_of(r, g, logarithm);
        const real up = SQRT(e.reach * e.A * e.determinant) + MARGIN;
        const real across = SQRT(e.reach * e.C * e.determinant) + MARGIN;
        real top = cell_from(e.y - up, height, r->rows), bottom = cell_to(e.y + up, height, r->rows);
        real left = cell_from(e.x - across, width, r->columns), right = cell_to(e.x + across, width, r->columns);
        if (r->tile_size) { /* gsplat 1.4 draws in the tiles alone that the square box touches */
            const real radius = r->radii[g];
            left = larger(left, FLOOR((e.x - radius) * scale) * per_row);
            right = smaller(right, CEIL((e.x + radius) * scale) * per_row);
            top = larger(top, FLOOR((e.y - radius) * scale) * per_column);
            bottom = smaller(bottom, CEIL((e.y + radius) * scale) * per_column);
        }
        const int some = bottom > top && right > left;
        r->first_row[i] = some ? (int32_t)top : 0, r->high[i] = some ? (int32_t)(bottom - top) : 0;
        r->first_column[i] = some ? (int32_t)left : 0, r->wide[i] = some ? (int32_t)(right - left) : 0;
        r->logs[i] = logarithm;
    }
}

/* Bands of a Gaussian with so many rows: from its first on, at `band`; returns how many. */
ALWAYS int32_t bands_of(const Run *r, int64_t rank, int64_t *band) {
    const int32_t first = r->first_row[rank], high = r->high[rank];
    *band = r->chosen[rank] / r->each * r->bands + first / r->band_rows;
    return high ? (first + high - 1) / r->band_rows - first / r->band_rows + 1 : 0;
}

/* Where the items of each band and of each Gaussian begin, and its strips and the cells of its lists (at most). */
void fb_count_items(const Run *r) {
    const int64_t bands = (int64_t)r->cameras * r->bands;
    int32_t items = 0;
    for (int64_t i = r->begin; i < r->end; i++) {
        int64_t band;
        const int32_t count = bands_of(r, i, &band), first = r->first_row[i], last = first + r->high[i];
        r->starts[i - r->begin] = items, items += count;
        for (int64_t k = 0; k < count; k++) {
            int32_t from = (first / r->band_rows + k) * r->band_rows, to = from + r->band_rows;
            const int32_t strips = (to < last ? to : last) - (from > first ? from : first);
            r->band_items[band + k + 1]++, r->band_strips[band + k + 1] += strips;
            r->band_cells[band + k + 1] += strips * r->wide[i];
        }
    }
    r->starts[r->end - r->begin] = items;
    for (int64_t b = 0; b < bands; b++) {
        r->band_items[b + 1] += r->band_items[b], r->band_strips[b + 1] += r->band_strips[b];
        r->band_cells[b + 1] += r->band_cells[b];
    }
}

/* The items themselves; `next` holds where each band's begin, and is moved on. */
void fb_place_items(const Run *r, int32_t *next) {
    for (int64_t i = r->begin; i < r->end; i++) {
        int64_t band;
        const int32_t count = bands_of(r, i, &band);
        for (int32_t k = 0; k < count; k++) {
            const int32_t item = next[band + k]++;
            r->ranks[item] = (int32_t)i, r->places[r->starts[i - r->begin] + k] = item;
        }
    }
}

/* Strips of ellipses, in columns; the names are those of `Strips` in ../tiles/cells.py. `low`: the first pixel centre
 * of the strip, from the ellipse's centre; `at`: the strip's first cell in the band.
 */
typedef real column[BLOCK];
typedef struct { column x, low, skew, over_A, over_yy, reach, turn, left, right; int32_t at[BLOCK]; } Strips;

ALWAYS real edge(const Strips *s, int i, real turning, real height, real side) {
    const real low = s->low[i], high = low + height, bounded = turning > low ? turning : low;
    const real y = bounded < high ? bounded : high, inside = s->reach[i] - y * y * s->over_yy[i];
    return s->skew[i] * y + s->x[i] + side * (SQRT((inside < 0 ? 0 : inside) * s->over_A[i]) + MARGIN);
}

/* First cell and number of cells of each strip; one that is no number has none. */
static void measure(const Run *r, const Strips *restrict s, int32_t *restrict cell, int32_t *restrict wide) {
    const real over_width = 1 / (real)r->cell_width, height = r->cell_height - 1; /* a power of two: exact */
    EACH {
        real from = FLOOR(CEIL(edge(s, i, -s->turn[i], height, -1) - HALF) * over_width);
        real to = FLOOR(FLOOR(edge(s, i, s->turn[i], height, 1) - HALF) * over_width) + 1;
        const real left = s->left[i], right = s->right[i];
        from = from > left ? from : left, from = from < right ? from : right;
        to = to > from ? to : from, to = to < right ? to : right;
        cell[i] = s->at[i] + (int32_t)from, wide[i] = (int32_t)(to - from);
    }
}

ALWAYS void table_row(const Run *r, const Ellipse *e, int64_t rank, real *row) {
    const int values = r->channels - 1;
    row[0] = r->logs[rank], row[1] = e->x, row[2] = e->y;
    row[3] = e->A * LOG2_E, row[4] = e->B * LOG2_E, row[5] = e->C * LOG2_E;
    for (int d = 0; d < values; d++) row[GEOMETRY + d] = r->values[rank * values + d];
    row[GEOMETRY + values] = 1;
}

/* Measure the first `count` of the block, keep them, and count them in the cells. */
static void keep(const Run *r, const Strips *s, int count, int64_t strip, int32_t *counts) {
    int32_t cell[BLOCK], wide[BLOCK];
    measure(r, s, cell, wide);
    memcpy(r->strip_cells + strip, cell, sizeof(int32_t) * count);
    memcpy(r->strip_wide + strip, wide, sizeof(int32_t) * count);
    for (int i = 0; i < count; i++)
        for (int32_t c = cell[i]; c < cell[i] + wide[i]; c++) counts[c]++;
}

/* The rows of the table and the lists of one band. */
void list_band(const Run *r, int64_t band) {
    const int32_t picture = (int32_t)(band / r->bands), top = (int32_t)(band % r->bands) * r->band_rows;
    const int32_t bottom = top + r->band_rows < r->rows ? top + r->band_rows : r->rows;
    const int64_t first_cell = ((int64_t)picture * r->rows + top) * r->columns;
    const int64_t cells = (int64_t)(bottom - top) * r->columns;
    const int pixels = r->cell_width * r->cell_height;
    int32_t *starts = r->list_starts + first_cell, *counts = r->list_counts + first_cell;
    memset(counts, 0, sizeof(int32_t) * cells);
    Strips block;
    memset(&block, 0, sizeof block);
    int64_t strip = r->band_strips[band];
    int filled = 0;
    for (int64_t item = r->band_items[band]; item < r->band_items[band + 1]; item++) {
        const int64_t rank = r->ranks[item];
        const Ellipse e = ellipse_of(r, r->chosen[rank], r->logs[rank]);
        const real over_A = 1 / e.A, over_yy = 1 / (e.A * e.determinant), skew = -e.B * over_A;
        /* root by root: the product overflows for Gaussians much larger than the picture */
        const real turn = -(SQRT(e.determinant) * e.B / SQRT(e.C) * SQRT(e.reach));
        table_row(r, &e, rank, r->table + item * r->stride);
        const int32_t from_row = r->first_row[rank] > top ? r->first_row[rank] : top;
        const int32_t end = r->first_row[rank] + r->high[rank], to_row = end < bottom ? end : bottom;
        for (int32_t row = from_row; row < to_row; row++) {
            block.x[filled] = e.x, block.low[filled] = row * (real)r->cell_height + HALF - e.y;
            block.skew[filled] = skew, block.over_A[filled] = over_A, block.over_yy[filled] = over_yy;
            block.reach[filled] = e.reach, block.turn[filled] = turn;
            block.left[filled] = r->first_column[rank], block.right[filled] = r->first_column[rank] + r->wide[rank];
            block.at[filled] = (row - top) * r->columns;
            if (++filled == BLOCK) keep(r, &block, BLOCK, strip, counts), strip += BLOCK, filled = 0;
        }
    }
    keep(r, &block, filled, strip, counts);
    int32_t next = r->band_cells[band];
    for (int64_t c = 0; c < cells; c++) {
        int alive = !r->light_before;
        for (int p = 0; p < pixels && !alive; p++) alive = r->light_before[(first_cell + c) * pixels + p] > 0;
        starts[c] = next, next += counts[c];
        counts[c] = alive ? 0 : -1; /* pixels have all stopped: no list */
    }
    strip = r->band_strips[band];
    for (int64_t item = r->band_items[band]; item < r->band_items[band + 1]; item++) {
        const int64_t rank = r->ranks[item];
        const int32_t from_row = r->first_row[rank] > top ? r->first_row[rank] : top;
        const int32_t end = r->first_row[rank] + r->high[rank], to_row = end < bottom ? end : bottom;
        for (int32_t row = from_row; row < to_row; row++, strip++)
            for (int32_t c = r->strip_cells[strip]; c < r->strip_cells[strip] + r->strip_wide[strip]; c++)
                if (counts[c] >= 0) r->lists[starts[c] + counts[c]++] = (int32_t)item;
    }
    for (int64_t c = 0; c < cells; c++) counts[c] = counts[c] < 0 ? 0 : counts[c];
}

/* Gradients of the Gaussians with ranks from first to last, of what they have gained in their bands. */
void fb_gather(
    const Run *r, int64_t first, int64_t last, const real *sums, real *means2d, real *absgrad, real *conics,
    real *opacities, real *values
) {
    const int used = PULLS + r->channels - 1;
    for (int64_t i = first; i < last; i++) {
        const int64_t g = r->chosen[i];
        const int32_t from = r->starts[i - r->begin], to = r->starts[i - r->begin + 1];
        real m[PULLS + 16] = {0};
        for (int32_t k = from; k < to; k++) {
            const real *row = sums + (int64_t)r->places[k] * r->stride;
            for (int c = 0; c < used; c++) m[c] += row[c];
        }
        const real A = r->conics[3 * g], B = r->conics[3 * g + 1], C = r->conics[3 * g + 2];
        means2d[2 * g] = -(A * m[1] + B * m[2]), means2d[2 * g + 1] = -(B * m[1] + C * m[2]);
        conics[3 * g] = -HALF * m[3], conics[3 * g + 1] = -m[4], conics[3 * g + 2] = -HALF * m[5];
        opacities[g] = m[0] / r->opacities[g];
        if (absgrad) absgrad[2 * g] = m[6], absgrad[2 * g + 1] = m[7];
        for (int d = 0; d < r->channels - 1; d++) values[i * (r->channels - 1) + d] = m[PULLS + d];
    }
}
