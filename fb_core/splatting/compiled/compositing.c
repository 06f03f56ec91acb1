/* Compositing, forward and backward: what ../tiles does with torch, in one pass.
 *
 * Plain C for gcc or clang, no header of Python or torch; `library.py` compiles it where there is a compiler. Rules per
 * pixel as in ../tiles/blocks.py: skip alpha < 1/255, cap alpha, stop before the Gaussian that would bring the
 * transmittance to 1e-4 or below.
 *
 * Exponents are to the base 2. A cell has 8 x 4 pixels, or 4 x 4; LANES of them are worked on at once.
 */
#include "run.h"

#ifdef __AVX512F__
#define LANES (64 / BYTES)
#else
#define LANES (32 / BYTES)
#endif
#define MOST_CHANNELS 16 /* values and alpha */
#define MOST_VECTORS (32 / LANES)
#define AHEAD 6 /* Gaussians whose rows are on their way to the cache */
#define STOP ((real)1e-4)
#define LOG_2 ((real)0.69314718055994531)

typedef real vec __attribute__((vector_size(LANES * sizeof(real))));
typedef whole ivec __attribute__((vector_size(LANES * sizeof(real))));

ALWAYS vec load(const real *from) { vec v; memcpy(&v, from, sizeof v); return v; }
ALWAYS void store(real *to, vec v) { memcpy(to, &v, sizeof v); }
ALWAYS vec splat(real x) { return x - (vec){0}; }
ALWAYS vec where(ivec yes, vec a) { return (vec)((ivec)a & yes); } /* a or 0 */
ALWAYS vec choose(ivec yes, vec a, vec b) { return (vec)(((ivec)a & yes) | ((ivec)b & ~yes)); }
ALWAYS vec absolute(vec a) { return (vec)((ivec)a & ~(whole)((uint64_t)1 << (8 * sizeof(real) - 1))); }
ALWAYS int any(ivec m) { whole e = 0; for (int l = 0; l < LANES; l++) e |= m[l]; return e != 0; }

/* 2^x: the power series on [-1/2, 1/2], and the whole part into the exponent. Below 2^-126 it stays there. */
ALWAYS vec power_of_2(vec x) {
#ifdef DOUBLE
    const real shift = 6755399441055744.0; /* 1.5 * 2^52: adding it rounds to a whole number */
    static const real series[] = {2.5678435993488206e-11, 4.4455382718708116e-10, 7.0549116208011233e-09,
        1.0178086009239699e-07, 1.3215486790144309e-06, 1.5252733804059840e-05, 1.5403530393381609e-04,
        1.3333558146428443e-03, 9.6181291076284771e-03, 5.5504108664821580e-02, 2.4022650695910072e-01,
        6.9314718055994531e-01, 1.0};
    const int mantissa = 52;
#else
    const real shift = 12582912.0f; /* 1.5 * 2^23 */
    static const real series[] = {1.54035304e-4f, 1.33335581e-3f, 9.61812911e-3f, 5.55041087e-2f, 2.40226507e-1f,
        6.93147181e-1f, 1.0f};
    const int mantissa = 23;
#endif
    x = choose(x < -126, splat(-126), x);
    x = choose(x > 1, splat(1), x); /* rounding noise: alpha is cut anyway */
    vec rounded = x + shift, f = x - (rounded - shift), p = splat(series[0]);
    for (unsigned i = 1; i < sizeof series / sizeof *series; i++) p = p * f + series[i];
    return (vec)((ivec)p + ((ivec)rounded << mantissa));
}

/* The exponents' polynomial about the centre of a cell, and u, v of its pixels. */
typedef struct { vec u[MOST_VECTORS], v[MOST_VECTORS]; int vectors; } Pixels;

ALWAYS Pixels pixels_of(const Run *s) {
    Pixels p;
    p.vectors = s->cell_width * s->cell_height / LANES;
    for (int i = 0; i < p.vectors; i++)
        for (int l = 0; l < LANES; l++) {
            int at = i * LANES + l;
            p.u[i][l] = at % s->cell_width - (s->cell_width - 1) * HALF;
            p.v[i][l] = at / s->cell_width - (s->cell_height - 1) * HALF;
        }
    return p;
}

typedef struct { real k0, k1, k2, k3, k4, k5, dx, dy; } Polynomial;

ALWAYS Polynomial polynomial_of(const real *row, real x, real y) {
    Polynomial k;
    real dx = row[1] - x, dy = row[2] - y, A = row[3], B = row[4], C = row[5];
    k.dx = dx, k.dy = dy;
    k.k1 = A * dx + B * dy, k.k2 = B * dx + C * dy;
    k.k0 = row[0] - HALF * (dx * k.k1 + dy * k.k2);
    k.k3 = -HALF * A, k.k4 = -B, k.k5 = -HALF * C;
    return k;
}

ALWAYS vec exponent_at(const Polynomial *k, vec u, vec v) {
    vec along = k->k3 * u + (k->k4 * v + k->k1);
    return along * u + ((k->k5 * v + k->k2) * v + k->k0);
}

ALWAYS void centre_of(const Run *s, int64_t cell, real *x, real *y) {
    int64_t in_picture = cell % ((int64_t)s->columns * s->rows);
    *x = (in_picture % s->columns + HALF) * s->cell_width;
    *y = (in_picture / s->columns + HALF) * s->cell_height;
}

/* Where a cell lies in the pictures: its first pixel, and how many rows and columns of it are inside. */
typedef struct { int64_t first; int32_t across, down; } Window;

ALWAYS Window window_of(const Run *s, int64_t cell) {
    const int64_t each = (int64_t)s->columns * s->rows, in_picture = cell % each;
    const int32_t x = (int32_t)(in_picture % s->columns) * s->cell_width;
    const int32_t y = (int32_t)(in_picture / s->columns) * s->cell_height;
    Window w = {.first = (cell / each * s->height + y) * s->width + x, .across = s->width - x, .down = s->height - y};
    w.across = w.across < s->cell_width ? w.across : s->cell_width;
    w.down = w.down < s->cell_height ? w.down : s->cell_height;
    return w;
}

/* Channels of a cell's pixels from the pictures (zeros beyond the border), or back to them. */
ALWAYS void read_cell(
    const Run *s, Window w, const real *colors, const real *alphas, vec (*to)[MOST_VECTORS], const int D, const int N
) {
    real pixels[MOST_CHANNELS][32];
    if (w.across < s->cell_width || w.down < s->cell_height) memset(pixels, 0, sizeof pixels);
    for (int y = 0; y < w.down; y++)
        for (int x = 0; x < w.across; x++) {
            const int64_t from = w.first + (int64_t)y * s->width + x;
            for (int d = 0; d < D - 1; d++) pixels[d][y * s->cell_width + x] = colors[from * (D - 1) + d];
            pixels[D - 1][y * s->cell_width + x] = alphas[from];
        }
    for (int d = 0; d < D; d++)
        for (int i = 0; i < N; i++) to[d][i] = load(pixels[d] + i * LANES);
}

ALWAYS void write_cell(
    const Run *s, Window w, const vec (*from)[MOST_VECTORS], real *colors, real *alphas, const int D, const int N
) {
    real pixels[MOST_CHANNELS][32];
    for (int d = 0; d < D; d++)
        for (int i = 0; i < N; i++) store(pixels[d] + i * LANES, from[d][i]);
    for (int y = 0; y < w.down; y++)
        for (int x = 0; x < w.across; x++) {
            const int64_t to = w.first + (int64_t)y * s->width + x;
            for (int d = 0; d < D - 1; d++) colors[to * (D - 1) + d] = pixels[d][y * s->cell_width + x];
            alphas[to] = pixels[D - 1][y * s->cell_width + x];
        }
}

ALWAYS void forward_cells(const Run *s, int64_t first, int64_t last, const int D, const int N) {
    const Pixels at = pixels_of(s);
    const int P = N * LANES;
    const real below = (real)s->below, cap = (real)s->cap;
    for (int64_t cell = first; cell < last; cell++) {
        const int32_t *list = s->lists + s->list_starts[cell];
        const int32_t count = s->list_counts[cell];
        const Window window = window_of(s, cell);
        real x, y;
        centre_of(s, cell, &x, &y);
        vec sum[MOST_CHANNELS][MOST_VECTORS], T[MOST_VECTORS];
        ivec live[MOST_VECTORS], end[MOST_VECTORS];
        for (int d = 0; d < D; d++)
            for (int i = 0; i < N; i++) sum[d][i] = splat(0);
        if (s->light_before) read_cell(s, window, s->colors, s->alphas, sum, D, N);
        for (int i = 0; i < N; i++) { /* negative: stopped in an earlier run of Gaussians */
            T[i] = s->light_before ? load(s->light_before + cell * P + i * LANES) : splat(1);
            live[i] = T[i] > 0;
            T[i] = absolute(T[i]);
            end[i] = live[i] & count;
        }
        ivec stopped = {0};
        for (int32_t r = 0; r < count; r++) {
            const real *row = s->table + (int64_t)list[r] * s->stride;
            if (r + AHEAD < count) __builtin_prefetch(s->table + (int64_t)list[r + AHEAD] * s->stride);
            const Polynomial k = polynomial_of(row, x, y);
            ivec stopping = {0};
            for (int i = 0; i < N; i++) {
                vec a = power_of_2(exponent_at(&k, at.u[i], at.v[i]));
                a = where((a > below) & live[i], a);
                a = choose(a > cap, splat(cap), a);
                vec w = a * T[i], next = T[i] - w;
                ivec ends = (next <= STOP) & live[i];
                end[i] = (ivec)choose(ends, (vec)((ivec){0} + r), (vec)end[i]);
                live[i] &= ~ends;
                w = where(live[i], w);
                T[i] -= w;
                stopping |= ends;
                for (int d = 0; d < D; d++) sum[d][i] += row[GEOMETRY + d] * w;
            }
            stopped |= stopping;
            if ((r & 3) == 3 && any(stopped)) { /* a look at every pixel costs as much as a Gaussian */
                stopped = (ivec){0};
                ivec left = {0};
                for (int i = 0; i < N; i++) left |= live[i];
                if (!any(left)) break;
            }
        }
        for (int i = 0; i < N; i++) {
            store(s->light + cell * P + i * LANES, choose(live[i], T[i], -T[i]));
            memcpy(s->stop + cell * P + i * LANES, &end[i], sizeof(ivec));
        }
        write_cell(s, window, (const vec (*)[MOST_VECTORS])sum, s->colors, s->alphas, D, N);
    }
}

/* Sums over lanes, as many vectors at once as there are lanes: every fold halves what belongs to one vector and puts
 * two of them side by side, until lane j holds the sum of vector j.
 */
#if LANES == 16
#define LOW 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23
#define HIGH 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31
#elif LANES == 8
#define LOW 0, 8, 1, 9, 2, 10, 3, 11
#define HIGH 4, 12, 5, 13, 6, 14, 7, 15
#else
#define LOW 0, 4, 1, 5
#define HIGH 2, 6, 3, 7
#endif
#if defined(__clang__) || __GNUC__ >= 12
#define MIXED(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define MIXED(a, b, ...) __builtin_shuffle(a, b, (ivec){__VA_ARGS__})
#endif

ALWAYS vec fold(vec a, vec b) { return MIXED(a, b, LOW) + MIXED(a, b, HIGH); }

/* What one Gaussian and the pixels of one cell have to do with each other, and the columns of its row of gradients: a
 * column is worked out where it is folded, so that few of them are held at a time.
 */
typedef struct {
    vec g[MOST_VECTORS], w[MOST_VECTORS], x[MOST_VECTORS], y[MOST_VECTORS]; /* slopes, weights, mean - pixel */
    real A, B, C;                                                            /* conic */
    const vec (*upstream)[MOST_VECTORS];
} Pairs;

ALWAYS vec column(const Pairs *p, const int q, const int absgrad, const int D, const int N) {
    vec sum = {0};
#pragma GCC unroll 8
    for (int i = 0; i < N; i++) {
        vec g = p->g[i], x = p->x[i], y = p->y[i];
        switch (q) { /* moments 1, x, y, xx, xy, yy; absolute pulls along x and y; values */
        case 0: sum += g; break;
        case 1: sum += g * x; break;
        case 2: sum += g * y; break;
        case 3: sum += g * x * x; break;
        case 4: sum += g * x * y; break;
        case 5: sum += g * y * y; break;
        case 6: if (absgrad) sum += absolute(g) * absolute(p->A * x + p->B * y); break;
        case 7: if (absgrad) sum += absolute(g) * absolute(p->B * x + p->C * y); break;
        default: if (q - PULLS < D - 1) sum += p->w[i] * p->upstream[q - PULLS][i];
        }
    }
    return sum;
}

/* Of columns q, q + stride, ...: halves, quarters, ... of LANES columns. */
#define FOLDED(name, stride, inner) \
    ALWAYS vec name(const Pairs *p, const int q, const int absgrad, const int D, const int N) { \
        return fold(inner(p, q, absgrad, D, N), inner(p, q + stride, absgrad, D, N)); \
    }
#if LANES == 16
FOLDED(folded_8, 8, column)
FOLDED(folded_4, 4, folded_8)
FOLDED(folded_2, 2, folded_4)
#elif LANES == 8
FOLDED(folded_4, 4, column)
FOLDED(folded_2, 2, folded_4)
#else
FOLDED(folded_2, 2, column)
#endif
FOLDED(totals, 1, folded_2)

/* Back to front. What each Gaussian of a cell gains is added to its item's row of `sums` (`stride` columns, a multiple
 * of LANES); `behind` passes on what is seen behind a run, and is NULL where there is one only.
 */
typedef struct {
    const real *colors, *alphas; /* what arrives, as the pictures */
    real *behind, *sums;         /* [cells, pixels], [items, stride] */
    int32_t absgrad;
} Way;

ALWAYS void backward_cells(
    const Run *s, const Way *way, int64_t first, int64_t last, const int absgrad, const int D, const int N
) {
    const Pixels at = pixels_of(s);
    const int P = N * LANES;
    const int32_t width = s->stride;
    const real below = (real)s->below, cap = (real)s->cap;
    for (int64_t cell = first; cell < last; cell++) {
        const int32_t *list = s->lists + s->list_starts[cell];
        real x, y;
        centre_of(s, cell, &x, &y);
        vec U[MOST_CHANNELS][MOST_VECTORS], T[MOST_VECTORS], seen_behind[MOST_VECTORS];
        ivec end[MOST_VECTORS];
        whole deepest = 0;
        for (int i = 0; i < N; i++) {
            T[i] = absolute(load(s->light + cell * P + i * LANES));
            seen_behind[i] = way->behind ? load(way->behind + cell * P + i * LANES) : splat(0);
            memcpy(&end[i], s->stop + cell * P + i * LANES, sizeof(ivec));
            for (int l = 0; l < LANES; l++) deepest = end[i][l] > deepest ? end[i][l] : deepest;
        }
        if (!deepest) continue;
        read_cell(s, window_of(s, cell), way->colors, way->alphas, U, D, N);
        for (int32_t r = deepest - 1; r >= 0; r--) {
            const real *row = s->table + (int64_t)list[r] * s->stride;
            real *to = way->sums + (int64_t)list[r] * width;
            if (r >= AHEAD) {
                __builtin_prefetch(s->table + (int64_t)list[r - AHEAD] * s->stride);
                __builtin_prefetch(way->sums + (int64_t)list[r - AHEAD] * width, 1);
            }
            const Polynomial k = polynomial_of(row, x, y);
            const real A = row[3] * LOG_2, B = row[4] * LOG_2, C = row[5] * LOG_2;
            Pairs p = {.A = A, .B = B, .C = C, .upstream = (const vec (*)[MOST_VECTORS])U};
            for (int i = 0; i < N; i++) {
                vec a = power_of_2(exponent_at(&k, at.u[i], at.v[i]));
                a = where((a > below) & (r < end[i]), a);
                ivec capped = a > cap;
                a = choose(capped, splat(cap), a);
                vec shown = U[D - 1][i]; /* of alpha, whose value is 1 */
                for (int d = 0; d < D - 1; d++) shown += row[GEOMETRY + d] * U[d][i];
                vec difference = shown - seen_behind[i];
                T[i] = T[i] / (1 - a); /* in front of this Gaussian */
                vec w = a * T[i];
                seen_behind[i] += a * difference;
                p.w[i] = w, p.g[i] = where(~capped, w * difference);
                p.x[i] = k.dx - at.u[i], p.y[i] = k.dy - at.v[i];
            }
#pragma GCC unroll 8
            for (int q = 0; q < PULLS + D - 1; q += LANES) {
                store(to + q, load(to + q) + totals(&p, q, absgrad, D, N));
            }
        }
        if (way->behind)
            for (int i = 0; i < N; i++) store(way->behind + cell * P + i * LANES, seen_behind[i]);
    }
}

/* One copy for each number of channels that is common, with loops unrolled. */
#define FOR_CHANNELS(CALL) \
    switch (s->channels) { \
    case 2: CALL(2); break; \
    case 4: CALL(4); break; \
    case 5: CALL(5); break; \
    case 7: CALL(7); break; \
    case 8: CALL(8); break; \
    default: CALL(s->channels); \
    }

/* Cells of a band: from the first, returned, to `last`. */
ALWAYS int64_t cells_of(const Run *s, int64_t band, int64_t *last) {
    const int64_t picture = band / s->bands, top = band % s->bands * s->band_rows;
    const int64_t bottom = top + s->band_rows < s->rows ? top + s->band_rows : s->rows;
    *last = (picture * s->rows + bottom) * s->columns;
    return (picture * s->rows + top) * s->columns;
}

/* Lists and pictures of the bands from first to last. */
void fb_forward(const Run *s, int64_t first_band, int64_t last_band) {
    for (int64_t band = first_band; band < last_band; band++) {
        int64_t last, first = cells_of(s, band, &last);
        list_band(s, band);
#define FORWARD(D) \
    if (s->cell_width == 8) forward_cells(s, first, last, D, 32 / LANES); \
    else forward_cells(s, first, last, D, 16 / LANES)
        FOR_CHANNELS(FORWARD)
    }
}

void fb_backward(const Run *s, int64_t first_band, int64_t last_band, const Way *way) {
    for (int64_t band = first_band; band < last_band; band++) {
        int64_t last, first = cells_of(s, band, &last), item = s->band_items[band];
        memset(way->sums + item * s->stride, 0, sizeof(real) * s->stride * (s->band_items[band + 1] - item));
#define BACKWARD(D) \
    if (s->cell_width != 8) backward_cells(s, way, first, last, way->absgrad, D, 16 / LANES); \
    else if (way->absgrad) backward_cells(s, way, first, last, 1, D, 32 / LANES); \
    else backward_cells(s, way, first, last, 0, D, 32 / LANES)
        FOR_CHANNELS(BACKWARD)
    }
}
