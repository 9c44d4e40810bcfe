/* The paper's identification loss of a three-layer MLP and its gradient, over a batch: values and full Jacobians.

   The includer defines SINGLE (1: float, 0: double), NZ, NX, H (sizes), CURVE (SINE, TANH, RELU or SILU) and, if the
   norms below are to be squared, SQUARED 1. With
   t1 = W1 z + b1, a1 = s(t1), t2 = W2 a1 + b2, a2 = s(t2), y = W3 a2 + b3, D = diag s'(t), the loss of a sample is
   |S (y - f)| + |S_J * (J - df/dz)|, J = W3 D2 W2 D1 W1, entry by entry: what is normalised is weighed in physical
   units by scale [NX + NX NZ], first S, then S_J by rows. One sample a vector lane; a tile is T vectors of samples, few
   enough to stay in the cache. Matrices of a tile are [rows][T] or, of the Jacobian's part, [rows][C] in rows of LD:
   column o T + t is equation o of vector t. The T columns after these are the values' in G1 (a1) and G2 (the adjoint of
   t2), so that W2's gradient is one product. J is built from the output down, its gradient from the input up. */
#include "products.h"

#define SINE 0
#define TANH 1
#define RELU 2
#define SILU 3

#ifndef SQUARED
#define SQUARED 0
#endif
#define T (NX <= 12 ? 4 : NX <= 24 ? 2 : 1)
#define C (NX * T)
#define LD ((C + T) | 1)  /* an odd number of vectors between rows: powers of two share the cache's few sets */
/* s(t), s'(t), s''(t) of M x T vectors; t, in rows of ld, is overwritten by s. */
static void curve(int M, int ld, vec *t, vec *d, vec *e)
{
    for (int m = 0; m < M; ++m, t += ld, d += T, e += T)
        for (int i = 0; i < T; ++i) {
            const vec x = t[i];
#if CURVE == SINE
            t[i] = v_sin(x); d[i] = v_cos(x); e[i] = -t[i];
#elif CURVE == TANH
            const vec s = v_tanh(x);
            t[i] = s; d[i] = 1 - s * s; e[i] = -2 * s * d[i];
#elif CURVE == RELU
            for (int k = 0; k < LANES; ++k) d[i][k] = x[k] > 0;
            t[i] = x * d[i]; e[i] = (vec){0};
#else
            const vec s = 1 / (1 + v_exp(-x)), slope = s * (1 - s);
            t[i] = x * s; d[i] = s + x * slope; e[i] = slope * (2 + x * (1 - 2 * s));
#endif
        }
}

/* Labels lie by rows: z, f, df/dz by rows, then zeros up to a multiple of 16 numbers. */
enum { VALUES = NZ + NX, ALL = VALUES + NX * NZ };

/* W1 [H, NZ], b1, W2 [H, H], b2, W3 [NX, H], b3, in this order in one array. */
enum { B1 = H * NZ, W2 = B1 + H, B2 = W2 + H * H, W3 = B2 + H, B3 = W3 + NX * H, PARAMETERS = B3 + NX };

typedef struct {
    vec z[NZ * T], f[NX * T], dfdz[NZ * LD];  /* labels; dfdz[i][o T + t] */
    vec d1[H * T], e1[H * T], a2[H * T], d2[H * T], e2[H * T], y[NX * T];
    vec G2[H * LD], P[H * LD], G1[H * LD], J[NZ * LD];  /* dy/dt2, dy/da1, dy/dt1, dy/dz */
    vec t1_bar[H * T], d1_bar[H * T], d2_bar[H * T];
} tile;

/* Where a label of vector 0 goes. */
INLINE vec *place(tile *s, int label)
{
    if (label < NZ) return s->z + label * T;
    if (label < VALUES) return s->f + (label - NZ) * T;
    return s->dfdz + (label - VALUES) % NZ * LD + (label - VALUES) / NZ * T;
}

/* Rows at[0 .. n - 1] of the labels, a lane each; lanes beyond n repeat the last row. */
static void load(tile *s, const int64_t *at, int64_t n, int labels, const real *rows)
{
    for (int t = 0; t < T; ++t) {
        const int64_t own = t * LANES < n ? t * LANES : n - 1;
        for (int first = 0; first < labels; first += LANES) {
            vec x[LANES];
            load_square(at + own, n - own, labels, rows, first, x);
            for (int i = 0; i < LANES && first + i < labels; ++i) place(s, first + i)[t] = x[i];
        }
    }
}

static void values(tile *s, const real *w)
{
    vec *a1 = s->G1 + C;
    product(H, NZ, w, NZ, 1, T, T, s->z, LD, a1);
    add_bias(H, T, w + B1, LD, a1);
    curve(H, LD, a1, s->d1, s->e1);
    product(H, H, w + W2, H, 1, T, LD, a1, T, s->a2);
    add_bias(H, T, w + B2, T, s->a2);
    curve(H, T, s->a2, s->d2, s->e2);
    product(NX, H, w + W3, H, 1, T, T, s->a2, T, s->y);
    add_bias(NX, T, w + B3, T, s->y);
}

static void jacobian(tile *s, const real *w)
{
    for (int j = 0; j < H; ++j)
        for (int o = 0; o < NX; ++o)
            for (int t = 0; t < T; ++t) s->G2[j * LD + o * T + t] = w[W3 + o * H + j] * s->d2[j * T + t];
    product(H, H, w + W2, 1, H, C, LD, s->G2, LD, s->P);
    for (int k = 0; k < H; ++k)
        for (int o = 0; o < NX; ++o)
            for (int t = 0; t < T; ++t) s->G1[k * LD + o * T + t] = s->P[k * LD + o * T + t] * s->d1[k * T + t];
    product(NZ, H, w, 1, NZ, C, LD, s->G1, LD, s->J);
}

/* The gradient of each sample's |scale (x - label)| (or its square), into x [rows][NX T] in rows of ld; 0 in lanes
   beyond `left`. Row r, equation o has scale[r + o stride]. Returns the sum of the norms. */
INLINE real units(int rows, int ld, vec *x, const vec *label, const real *scale, int stride, int64_t left)
{
    real total = 0;
    vec square[T];
    for (int t = 0; t < T; ++t) square[t] = (vec){0};
    for (int r = 0; r < rows; ++r)
        for (int c = 0; c < C; ++c) {
            x[r * ld + c] = (x[r * ld + c] - label[r * ld + c]) * scale[r + c / T * stride];
            square[c % T] += x[r * ld + c] * x[r * ld + c];
        }
    for (int t = 0; t < T; ++t)
        for (int lane = 0; lane < LANES; ++lane) {
            const real norm = F(sqrt)(square[t][lane]);
            const int own = t * LANES + lane < left;
            total += own ? (SQUARED ? square[t][lane] : norm) : 0;
            square[t][lane] = own && norm > 0 ? (SQUARED ? 2 : 1 / norm) : 0;
        }
    for (int r = 0; r < rows; ++r)
        for (int c = 0; c < C; ++c) x[r * ld + c] *= square[c % T] * scale[r + c / T * stride];
    return total;
}

/* The Jacobian's part of the gradient, from J (now its adjoint): into g, and d1_bar, d2_bar for the values' part.
   The adjoints of dy/dt1 and dy/dt2 take the places of G1 and P, which are not needed by then. */
static void jacobian_backward(tile *s, const real *w, real *g)
{
    vec *G1_bar = s->G1, *G2_bar = s->P;
    outer(H, NZ, C, LD, s->G1, s->J, g);
    product(H, NZ, w, NZ, 1, C, LD, s->J, LD, G1_bar);
    for (int k = 0; k < H; ++k)
        for (int t = 0; t < T; ++t) {
            vec sum = (vec){0};
            for (int o = 0; o < NX; ++o) {
                const int c = k * LD + o * T + t;
                sum += G1_bar[c] * s->P[c];
                G1_bar[c] *= s->d1[k * T + t];  /* now the adjoint of P */
            }
            s->d1_bar[k * T + t] = sum;
        }
    product(H, H, w + W2, H, 1, C, LD, G1_bar, LD, G2_bar);
    for (int j = 0; j < H; ++j) {
        for (int t = 0; t < T; ++t) s->d2_bar[j * T + t] = (vec){0};
        for (int o = 0; o < NX; ++o) {
            vec sum = (vec){0};
            for (int t = 0; t < T; ++t) {
                const vec bar = G2_bar[j * LD + o * T + t];
                s->d2_bar[j * T + t] += w[W3 + o * H + j] * bar;
                sum += bar * s->d2[j * T + t];
            }
            g[W3 + o * H + j] += sum_of(sum);
        }
    }
}

/* x = x s'(t) and what the Jacobian's part hands to s'(t) itself; x in rows of ld. */
INLINE void through_curve(int ld, vec *x, const vec *d, const vec *d_bar, const vec *e, int with_jacobian)
{
    for (int m = 0; m < H; ++m)
        for (int t = 0; t < T; ++t) {
            const int i = m * T + t;
            x[m * ld + t] = x[m * ld + t] * d[i] + (with_jacobian ? d_bar[i] * e[i] : (vec){0});
        }
}

/* The values' part of the gradient, from y (now its adjoint), with W2's of both parts. */
static void values_backward(tile *s, const real *w, real *g, int with_jacobian)
{
    const vec *a1 = s->G1 + C;
    vec *t2_bar = s->G2 + C;
    outer(NX, H, T, T, s->y, s->a2, g + W3);
    add_sums(NX, T, T, s->y, g + B3);
    product(H, NX, w + W3, 1, H, T, T, s->y, LD, t2_bar);
    through_curve(LD, t2_bar, s->d2, s->d2_bar, s->e2, with_jacobian);
    if (with_jacobian) outer(H, H, C + T, LD, s->G2, s->G1, g + W2);
    else outer(H, H, T, LD, t2_bar, a1, g + W2);
    add_sums(H, T, LD, t2_bar, g + B2);
    product(H, H, w + W2, 1, H, T, LD, t2_bar, T, s->t1_bar);
    through_curve(T, s->t1_bar, s->d1, s->d1_bar, s->e1, with_jacobian);
    outer(H, NZ, T, T, s->t1_bar, s->z, g);
    add_sums(H, T, T, s->t1_bar, g + B1);
}

/* bytes[0] = what nocl_loss needs as `work`. */
void nocl_loss_work(int64_t first_block, int64_t last_block, const int64_t *at, int64_t *bytes)
{
    (void)first_block, (void)last_block, (void)at;
    *bytes = sizeof(tile) + BYTES;
}

/* The mean of the loss over rows at[0 .. n - 1] and its gradient g [PARAMETERS]; without Jacobians: of values alone.
   All rows are taken, whatever the blocks. */
void nocl_loss(int64_t first_block, int64_t last_block, const int64_t *at, int64_t n, const real *w, const real *rows,
               int64_t with_jacobian, const real *scale, char *work, real *g, double *loss)
{
    (void)first_block, (void)last_block;
    tile *s = (tile *)(work + BYTES - (uintptr_t)work % BYTES);
    const int labels = with_jacobian ? ALL : VALUES;
    *loss = 0;
    memset(g, 0, PARAMETERS * sizeof(real));
    for (int64_t first = 0; first < n; first += T * LANES) {
        const int64_t left = n - first;
        load(s, at + first, left, labels, rows);
        prefetch(at + first + T * LANES, left < 2 * T * LANES ? left - T * LANES : T * LANES, labels, rows);
        values(s, w);
        *loss += units(1, C, s->y, s->f, scale, 1, left) / n;
        if (with_jacobian) {
            jacobian(s, w);
            *loss += units(NZ, LD, s->J, s->dfdz, scale + NX, NZ, left) / n;
            jacobian_backward(s, w, g);
        }
        values_backward(s, w, g, with_jacobian);
    }
    for (int i = 0; i < PARAMETERS; ++i) g[i] /= n;
}

int64_t nocl_width(void) { return LANES; }
