/* Gaussians into one camera, and the way back of their gradient: `footprint`, `footprint_gradient` and the culling of
 * ../projection.py, formula by formula and in the same order; the notation is that of ../footprint.py.
 *
 * Gaussians go by blocks of BLOCK, in columns, so that a compiler makes vectors of the loops. Products and sums are not
 * contracted: torch rounds both as well, and what cancels exactly there (a flat covariance) does here. Loops are
 * vectorised, straight-line code is not: gcc 12 at -O3 makes wrong 256-bit code of `axes_gradient` unrolled.
 */
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#else
#pragma GCC optimize("tree-loop-vectorize", "no-tree-slp-vectorize", "vect-cost-model=dynamic", "fp-contract=off")
#endif
#include "vectors.h"

#define BLOCK 64
#define CHUNK 2048 /* Gaussians whose part of the camera's gradient is summed apart, whatever the number of threads */
#define LARGEST_RADIUS ((real)1073741824.0)
#define EACH for (int i = 0; i < BLOCK; i++)

typedef struct {
    int64_t number;
    const real *means, *quats, *scales, *covars; /* [n, 3], [n, 4], [n, 3]; or in place of both [n, 3, 3] */
    const real *opacities;
    const uint8_t *usable; /* NULL: all */
} Splats;

typedef struct {
    double view[12]; /* world to camera, three rows of four */
    double fx, fy, cx, cy, left, right, top, bottom; /* as `Lens` */
    double width, height, near, far, clip, blur, floor;
    int32_t antialiased, square;
} Camera;

typedef struct {
    real *means2d, *conics, *depths, *compensations, *determinants; /* [n, 2], [n, 3], [n], [n], [n] */
    int32_t *radii;                                                 /* [n] where boxes are square, else [n, 2] */
} Screen;

typedef struct {
    const real *means2d, *conics, *depths, *compensations; /* as in Screen; NULL: nothing arrives */
    const int32_t *radii;
    real *means, *quats, *scales, *covars; /* as in Splats; added to; NULL: not wanted */
    double *view;                          /* [chunks, 12]; NULL: not wanted */
} Gradients;

typedef real column[BLOCK];
typedef struct {
    column mean[3], quat[4], scale[3], cov[9];
    column inverse, Q[9]; /* one over the quaternion's length; rotation */
    column u, v, x, y, z, jx, jxz, jy, jyz;
    column G[6], H[6]; /* G, and H or G C: two rows of three */
    column a, b, c, sharp, det;
} Block;

ALWAYS void fetch(const real *from, int width, const int64_t *rows, column *to) {
    EACH for (int k = 0; k < width; k++) to[k][i] = from[rows[i] * width + k];
}

ALWAYS real clamped(real x, real low, real high) { return x < low ? low : x > high ? high : x; } /* NaN stays */

static void place(Block *restrict o, const Camera *c) {
    const double *m = c->view;
    const real fx = (real)c->fx, fy = (real)c->fy, left = (real)c->left, right = (real)c->right;
    const real top = (real)c->top, bottom = (real)c->bottom;
    EACH { /* centres in double: their rounding is what float32 pictures lose first */
        double X = o->mean[0][i], Y = o->mean[1][i], Z = o->mean[2][i];
        double x = m[0] * X + m[1] * Y + m[2] * Z + m[3], y = m[4] * X + m[5] * Y + m[6] * Z + m[7];
        double z = m[8] * X + m[9] * Y + m[10] * Z + m[11];
        o->u[i] = (real)(x / z * c->fx + c->cx), o->v[i] = (real)(y / z * c->fy + c->cy);
        o->x[i] = (real)x, o->y[i] = (real)y, o->z[i] = (real)z;
    }
    EACH {
        real over = 1 / o->z[i];
        real jx = over * fx, jy = over * fy;
        real jxz = -(clamped(o->x[i] * over, left, right) * jx), jyz = -(clamped(o->y[i] * over, top, bottom) * jy);
        o->jx[i] = jx, o->jy[i] = jy, o->jxz[i] = jxz, o->jyz[i] = jyz;
        for (int k = 0; k < 3; k++) {
            o->G[k][i] = (real)m[k] * jx + (real)m[8 + k] * jxz;
            o->G[3 + k][i] = (real)m[4 + k] * jy + (real)m[8 + k] * jyz;
        }
    }
}

/* Unit quaternions (the identity where all is 0) and their rotations. */
static void turn(Block *restrict o) {
    EACH {
        real w = o->quat[0][i], x = o->quat[1][i], y = o->quat[2][i], z = o->quat[3][i];
        real length = SQRT(w * w + x * x + y * y + z * z);
        int zero = length <= 0;
        real over = 1 / (zero ? 1 : length);
        w = zero ? 1 : w * over, x *= over, y *= over, z *= over;
        o->inverse[i] = zero ? 0 : over;
        o->quat[0][i] = w, o->quat[1][i] = x, o->quat[2][i] = y, o->quat[3][i] = z;
        real x2 = 2 * x, y2 = 2 * y, z2 = 2 * z;
        o->Q[0][i] = 1 - (y * y2 + z * z2), o->Q[1][i] = x * y2 - w * z2, o->Q[2][i] = x * z2 + w * y2;
        o->Q[3][i] = x * y2 + w * z2, o->Q[4][i] = 1 - (x * x2 + z * z2), o->Q[5][i] = y * z2 - w * x2;
        o->Q[6][i] = x * z2 - w * y2, o->Q[7][i] = y * z2 + w * x2, o->Q[8][i] = 1 - (x * x2 + y * y2);
    }
}

static void footprint(Block *restrict o, const Camera *camera, const int by_axes) {
    const real blur = (real)camera->blur, blur_squared = (real)(camera->blur * camera->blur);
    place(o, camera);
    if (by_axes) turn(o);
    const column *M = by_axes ? (const column *)o->Q : (const column *)o->cov;
    EACH for (int k = 0; k < 3; k++) {
        o->H[k][i] = o->G[0][i] * M[k][i] + o->G[1][i] * M[3 + k][i] + o->G[2][i] * M[6 + k][i];
        o->H[3 + k][i] = o->G[3][i] * M[k][i] + o->G[4][i] * M[3 + k][i] + o->G[5][i] * M[6 + k][i];
    }
    if (by_axes) EACH {
        real p0 = o->H[0][i] * o->scale[0][i], p1 = o->H[1][i] * o->scale[1][i], p2 = o->H[2][i] * o->scale[2][i];
        real q0 = o->H[3][i] * o->scale[0][i], q1 = o->H[4][i] * o->scale[1][i], q2 = o->H[5][i] * o->scale[2][i];
        real m0 = p1 * q2 - p2 * q1, m1 = p2 * q0 - p0 * q2, m2 = p0 * q1 - p1 * q0;
        o->a[i] = p0 * p0 + p1 * p1 + p2 * p2, o->b[i] = p0 * q0 + p1 * q1 + p2 * q2;
        o->c[i] = q0 * q0 + q1 * q1 + q2 * q2, o->sharp[i] = m0 * m0 + m1 * m1 + m2 * m2;
    }
    else EACH {
        real g0 = o->G[0][i], g1 = o->G[1][i], g2 = o->G[2][i], f0 = o->G[3][i], f1 = o->G[4][i], f2 = o->G[5][i];
        o->a[i] = o->H[0][i] * g0 + o->H[1][i] * g1 + o->H[2][i] * g2;
        o->b[i] = o->H[0][i] * f0 + o->H[1][i] * f1 + o->H[2][i] * f2;
        o->c[i] = o->H[3][i] * f0 + o->H[4][i] * f1 + o->H[5][i] * f2;
        o->sharp[i] = o->a[i] * o->c[i] - o->b[i] * o->b[i];
    }
    EACH {
        o->det[i] = (o->a[i] + o->c[i]) * blur + blur_squared + o->sharp[i];
        o->a[i] += blur, o->c[i] += blur;
    }
}

ALWAYS void fetch_all(const Splats *s, const int64_t *rows, Block *o) {
    fetch(s->means, 3, rows, o->mean);
    if (s->covars) fetch(s->covars, 9, rows, o->cov);
    else fetch(s->quats, 4, rows, o->quat), fetch(s->scales, 3, rows, o->scale);
}

ALWAYS real compensation_of(const Block *o, int i, real least) {
    real ratio = o->sharp[i] / o->det[i];
    return SQRT(ratio < least ? least : ratio);
}

/* Gaussians from first to last: what lies on the screen, and zeros for those that are culled. */
void fb_project(const Splats *s, const Camera *c, int64_t first, int64_t last, const Screen *to) {
    const real least = (real)(c->floor * c->floor), near = (real)c->near, far = (real)c->far, clip = (real)c->clip;
    const real width = (real)c->width, height = (real)c->height;
    for (int64_t begin = first; begin < last; begin += BLOCK) {
        const int count = last - begin < BLOCK ? (int)(last - begin) : BLOCK;
        int64_t rows[BLOCK];
        Block o;
        column opacity, factor, rx, ry;
        int32_t drawn[BLOCK];
        EACH rows[i] = begin + (i < count ? i : count - 1);
        EACH opacity[i] = s->opacities[rows[i]];
        fetch_all(s, rows, &o);
        footprint(&o, c, !s->covars);
        EACH factor[i] = compensation_of(&o, i, least);
        if (c->antialiased) EACH opacity[i] *= factor[i];
        if (c->square) EACH {
            real half = (o.a[i] - o.c[i]) * HALF, square = half * half + o.b[i] * o.b[i];
            real gap = SQRT(square < (real)0.01 ? (real)0.01 : square);
            rx[i] = ry[i] = CEIL(SQRT((o.a[i] + o.c[i]) * HALF + gap) * 3);
        }
        else EACH {
            real shown = opacity[i] * 255, extent = SQRT(LOG(shown < 1 ? 1 : shown) * 2);
            extent = extent > (real)3.33 ? (real)3.33 : extent;
            rx[i] = CEIL(extent * SQRT(o.a[i])), ry[i] = CEIL(extent * SQRT(o.c[i]));
        }
        EACH {
            real x = rx[i], y = ry[i], u = o.u[i], v = o.v[i];
            int seen = (o.z[i] >= near) & (o.z[i] <= far) & (o.det[i] > 0) & (o.det[i] < (real)INFINITY);
            seen &= ((x > clip) | (y > clip)) & (x == x) & (y == y);
            seen &= (u + x > 0) & (u - x < width) & (v + y > 0) & (v - y < height);
            drawn[i] = seen & (c->square | (opacity[i] >= ALPHA_MIN));
        }
        if (s->usable) EACH drawn[i] &= s->usable[rows[i]];
        EACH {
            real over = 1 / o.det[i];
            o.x[i] = o.c[i] * over, o.y[i] = -o.b[i] * over, o.jx[i] = o.a[i] * over; /* the conic */
        }
        for (int i = 0; i < count; i++) {
            const int64_t n = begin + i;
            const int yes = drawn[i];
            to->means2d[2 * n] = yes ? o.u[i] : 0, to->means2d[2 * n + 1] = yes ? o.v[i] : 0;
            to->conics[3 * n] = yes ? o.x[i] : 0, to->conics[3 * n + 1] = yes ? o.y[i] : 0;
            to->conics[3 * n + 2] = yes ? o.jx[i] : 0;
            to->depths[n] = yes ? o.z[i] : 0, to->compensations[n] = yes ? factor[i] : 0;
            to->determinants[n] = yes ? o.det[i] : 0;
            int32_t across = yes ? (int32_t)(rx[i] < LARGEST_RADIUS ? rx[i] : LARGEST_RADIUS) : 0;
            int32_t down = yes ? (int32_t)(ry[i] < LARGEST_RADIUS ? ry[i] : LARGEST_RADIUS) : 0;
            if (c->square) to->radii[n] = across;
            else to->radii[2 * n] = across, to->radii[2 * n + 1] = down;
        }
    }
}

/* The way back of one block: what arrives and what leaves, in columns. */
typedef struct {
    column means2d[2], conics[3], depth, comp; /* arrive */
    column ground[6], shape[9], quat[4];       /* leave: G; scales, or covariances; quaternions */
    column point[3];
} Slopes;

/* d loss / d compensation^2 to `slope`, 1 - compensation^2 to `rest`. */
ALWAYS void compensation_slope(const Block *o, const Camera *c, const real *arriving, real *slope, real *rest) {
    const real least = (real)(c->floor * c->floor);
    EACH {
        real value = compensation_of(o, i, least);
        int low = (least > 0) & (o->sharp[i] <= least * o->det[i]);
        slope[i] = low ? 0 : HALF * arriving[i] / (value + (real)1e-6); /* gsplat's bound at 0 */
        rest[i] = 1 - value * value;
    }
}

static void axes_gradient(const Block *restrict o, const Camera *c, Slopes *restrict g, int conics, int compensations) {
    const real blur = (real)c->blur;
    column slope, rest;
    if (compensations) compensation_slope(o, c, g->comp, slope, rest);
    else EACH slope[i] = rest[i] = 0;
    EACH {
        const real over = 1 / o->det[i];
        const real s[3] = {o->scale[0][i] * o->scale[0][i], o->scale[1][i] * o->scale[1][i],
            o->scale[2][i] * o->scale[2][i]};
        const real h[3] = {o->H[0][i], o->H[1][i], o->H[2][i]}, f[3] = {o->H[3][i], o->H[4][i], o->H[5][i]};
        const real n[3] = {h[1] * f[2] - h[2] * f[1], h[2] * f[0] - h[0] * f[2], h[0] * f[1] - h[1] * f[0]};
        const real sh[3] = {s[0] * h[0], s[1] * h[1], s[2] * h[2]}, sf[3] = {s[0] * f[0], s[1] * f[1], s[2] * f[2]};
        const real y[3] = {(sf[1] * n[2] - sf[2] * n[1] + blur * h[0]) * over,
            (sf[2] * n[0] - sf[0] * n[2] + blur * h[1]) * over, (sf[0] * n[1] - sf[1] * n[0] + blur * h[2]) * over};
        const real t[3] = {(n[1] * sh[2] - n[2] * sh[1] + blur * f[0]) * over,
            (n[2] * sh[0] - n[0] * sh[2] + blur * f[1]) * over, (n[0] * sh[1] - n[1] * sh[0] + blur * f[2]) * over};
        real vh[3] = {0, 0, 0}, vf[3] = {0, 0, 0}, diagonal[3] = {0, 0, 0}, corner[3] = {0, 0, 0};
        if (conics) {
            const real A = g->conics[0][i], B = g->conics[1][i] * HALF, C = g->conics[2][i];
            const real xx = o->c[i] * over, xy = -o->b[i] * over, yy = o->a[i] * over;
            real w[3], r[3];
            for (int k = 0; k < 3; k++) {
                w[k] = y[k] * A + t[k] * B, r[k] = y[k] * B + t[k] * C;
                vh[k] = -(w[k] * xx + r[k] * xy), vf[k] = -(w[k] * xy + r[k] * yy);
                diagonal[k] = -(y[k] * w[k] + t[k] * r[k]);
            }
            corner[0] = -(y[1] * w[2]) - t[1] * r[2], corner[1] = -(y[2] * w[0]) - t[2] * r[0];
            corner[2] = -(y[0] * w[1]) - t[0] * r[1];
        }
        if (compensations) {
            real w[3], r[3];
            for (int k = 0; k < 3; k++) {
                w[k] = (y[k] * rest[i] - h[k] * (blur * over)) * slope[i];
                r[k] = (t[k] * rest[i] - f[k] * (blur * over)) * slope[i];
                vh[k] += w[k], vf[k] += r[k], diagonal[k] += h[k] * w[k] + f[k] * r[k];
            }
            corner[0] += h[1] * w[2] + f[1] * r[2], corner[1] += h[2] * w[0] + f[2] * r[0];
            corner[2] += h[0] * w[1] + f[0] * r[1];
        }
        for (int k = 0; k < 3; k++) {
            g->shape[k][i] = diagonal[k] * o->scale[k][i] * 2;
            vh[k] = vh[k] * s[k] * 2, vf[k] = vf[k] * s[k] * 2;
        }
        for (int j = 0; j < 3; j++) {
            const real q0 = o->Q[3 * j][i], q1 = o->Q[3 * j + 1][i], q2 = o->Q[3 * j + 2][i];
            g->ground[j][i] = vh[0] * q0 + vh[1] * q1 + vh[2] * q2;
            g->ground[3 + j][i] = vf[0] * q0 + vf[1] * q1 + vf[2] * q2;
        }
        const real twice = 2 * o->inverse[i];
        const real tx = 2 * corner[0] * (s[1] - s[2]) * twice, ty = 2 * corner[1] * (s[2] - s[0]) * twice;
        const real tz = 2 * corner[2] * (s[0] - s[1]) * twice;
        const real qw = o->quat[0][i], qx = o->quat[1][i], qy = o->quat[2][i], qz = o->quat[3][i];
        g->quat[0][i] = -(qx * tx) - qy * ty - qz * tz, g->quat[1][i] = qw * tx + qy * tz - qz * ty;
        g->quat[2][i] = qw * ty + qz * tx - qx * tz, g->quat[3][i] = qw * tz + qx * ty - qy * tx;
    }
}

static void covariance_gradient(
    const Block *restrict o, const Camera *c, Slopes *restrict g, int conics, int compensations
) {
    const real blur = (real)c->blur;
    column slope, rest;
    if (compensations) compensation_slope(o, c, g->comp, slope, rest);
    else EACH slope[i] = rest[i] = 0;
    EACH {
        const real over = 1 / o->det[i], A = o->c[i] * over, B = -o->b[i] * over, C = o->a[i] * over;
        real xx = 0, xy = 0, yy = 0;
        if (conics) {
            const real vA = g->conics[0][i], vB = g->conics[1][i] * HALF, vC = g->conics[2][i];
            const real p00 = A * vA + B * vB, p01 = A * vB + B * vC, p10 = B * vA + C * vB, p11 = B * vB + C * vC;
            xx = -(p00 * A + p01 * B), xy = -(p00 * B + p01 * C), yy = -(p10 * B + p11 * C);
        }
        if (compensations) {
            xx += slope[i] * (rest[i] * A - blur * over), xy += slope[i] * rest[i] * B;
            yy += slope[i] * (rest[i] * C - blur * over);
        }
        for (int k = 0; k < 3; k++) {
            const real p = o->G[k][i] * xx + o->G[3 + k][i] * xy, q = o->G[k][i] * xy + o->G[3 + k][i] * yy;
            for (int j = 0; j < 3; j++) g->shape[3 * j + k][i] = o->G[j][i] * p + o->G[3 + j][i] * q;
            g->ground[k][i] = (o->H[k][i] * xx + o->H[3 + k][i] * xy) * 2;
            g->ground[3 + k][i] = (o->H[k][i] * xy + o->H[3 + k][i] * yy) * 2;
        }
    }
}

static void point_gradient(const Block *restrict o, const Camera *c, Slopes *restrict g) {
    const double *m = c->view;
    const real fx = (real)c->fx, fy = (real)c->fy, left = (real)c->left, right = (real)c->right;
    const real top = (real)c->top, bottom = (real)c->bottom;
    EACH {
        real jx = 0, jy = 0, jxz = 0, jyz = 0;
        for (int k = 0; k < 3; k++) {
            jx += (real)m[k] * g->ground[k][i], jy += (real)m[4 + k] * g->ground[3 + k][i];
            jxz += (real)m[8 + k] * g->ground[k][i], jyz += (real)m[8 + k] * g->ground[3 + k][i];
        }
        const real over = 1 / o->z[i], sx = o->x[i] * over, sy = o->y[i] * over;
        /* where the clamp does not act, s moves as well; where it acts, only z moves J */
        real vx = (sx < left) | (sx > right) ? 0 : -(jxz * o->jx[i]);
        real vy = (sy < top) | (sy > bottom) ? 0 : -(jyz * o->jy[i]);
        vx += g->means2d[0][i] * fx, vy += g->means2d[1][i] * fy;
        real vz = jx * o->jx[i] + jxz * o->jxz[i] + jy * o->jy[i] + jyz * o->jyz[i] + vx * sx + vy * sy;
        g->point[0][i] = vx * over, g->point[1][i] = vy * over, g->point[2][i] = g->depth[i] - vz * over;
    }
}

/* The camera's gradient of the first `count` of a block, added to three rows of four. */
static void view_gradient(const Block *o, const Slopes *g, int count, double *view) {
    for (int i = 0; i < count; i++)
        for (int r = 0; r < 3; r++) {
            for (int k = 0; k < 3; k++) {
                const real across = g->ground[k][i], down = g->ground[3 + k][i];
                const real turned = r == 0 ? across * o->jx[i] : r == 1 ? down * o->jy[i] :
                    across * o->jxz[i] + down * o->jyz[i];
                view[4 * r + k] += turned + g->point[r][i] * o->mean[k][i];
            }
            view[4 * r + 3] += g->point[r][i];
        }
}

ALWAYS void add_rows(const column *from, int width, const int64_t *rows, int count, real *to) {
    if (to) for (int i = 0; i < count; i++)
        for (int k = 0; k < width; k++) to[rows[i] * width + k] += from[k][i];
}

static void block_gradient(
    const Splats *s, const Camera *c, int64_t *rows, int count, const Gradients *to, double *view
) {
    Block o;
    Slopes g;
    for (int i = count; i < BLOCK; i++) rows[i] = rows[0];
    fetch_all(s, rows, &o);
    footprint(&o, c, !s->covars);
    memset(g.means2d, 0, sizeof g.means2d), memset(g.depth, 0, sizeof g.depth);
    if (to->means2d) fetch(to->means2d, 2, rows, g.means2d);
    if (to->depths) fetch(to->depths, 1, rows, &g.depth);
    if (to->conics) fetch(to->conics, 3, rows, g.conics);
    if (to->compensations) fetch(to->compensations, 1, rows, &g.comp);
    if (s->covars) covariance_gradient(&o, c, &g, to->conics != NULL, to->compensations != NULL);
    else axes_gradient(&o, c, &g, to->conics != NULL, to->compensations != NULL);
    point_gradient(&o, c, &g);
    if (view) view_gradient(&o, &g, count, view);
    add_rows((const column *)g.quat, 4, rows, count, to->quats);
    add_rows((const column *)g.shape, 3, rows, count, to->scales);
    add_rows((const column *)g.shape, 9, rows, count, to->covars);
    column mean[3];
    for (int k = 0; k < 3; k++) {
        const real a = (real)c->view[k], b = (real)c->view[4 + k], d = (real)c->view[8 + k];
        EACH mean[k][i] = g.point[0][i] * a + g.point[1][i] * b + g.point[2][i] * d;
    }
    add_rows((const column *)mean, 3, rows, count, to->means);
}

/* The gradient of the drawn ones among the Gaussians of chunks first to last. */
void fb_project_backward(const Splats *s, const Camera *c, int64_t first, int64_t last, const Gradients *to) {
    const int step = c->square ? 1 : 2;
    for (int64_t chunk = first; chunk < last; chunk++) {
        int64_t end = (chunk + 1) * CHUNK < s->number ? (chunk + 1) * CHUNK : s->number, rows[BLOCK];
        double *view = to->view ? to->view + 12 * chunk : NULL;
        int count = 0;
        for (int64_t n = chunk * CHUNK; n < end; n++) {
            if (to->radii[n * step] > 0) rows[count++] = n;
            if (count == BLOCK) block_gradient(s, c, rows, count, to, view), count = 0;
        }
        if (count) block_gradient(s, c, rows, count, to, view);
    }
}
