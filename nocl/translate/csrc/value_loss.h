/* The loss of a value function V = |y|^2 and its gradient in the weights, over a batch: values and slopes.

   y is a tanh MLP of the features phi with a linear skip, in units in which V is dimensionless. Of a label (phi; the
   nonzeros of d phi / d x, V*, V_x*, and weights w, v) the loss is sqrt((w (V - V*))^2 + v |V_x - V_x*|^2 + ROUND^2).

   The includer defines SINGLE, NF, NX, NS (features, states, nonzeros of d phi / d x), LAYERS (of weights), SIZES
   {NF, widths, outputs}, WIDEST (of SIZES) and ROUND. V_x = (dV/dphi) (dphi/dx), and dV/dphi takes one pass down. The
   gradient of what depends on it is that of the tangent along g = (dphi/dx) dloss/dV_x, g held: one pass up, and its
   adjoints are those of the pass down. So a layer's gradient is one product of [values' adjoint, tangents' adjoint]
   with [values, tangents], 2 T columns. One sample a vector lane, a tile is T vectors of samples. */
#include "products.h"

#define T 4
#define LD (2 * T + 1)  /* an odd number of vectors between rows: powers of two share the cache's few sets */
enum { LABELS = NF + NS + NX + 3 };

static const int size[LAYERS + 1] = SIZES;

typedef struct {
    vec in[LAYERS + 1][WIDEST * LD];   /* [l]: the values after l layers (0: features), then their tangents */
    vec out[LAYERS + 1][WIDEST * LD];  /* [l]: the adjoints of what enters layer l's tanh, of values, of tangents */
    vec q[LAYERS + 1][WIDEST * T], rate[LAYERS + 1][WIDEST * T];  /* dV/din[l]; tangents before tanh */
    vec slope[NS * T], V[3 * T], V_x[NX * T];  /* labels; V: V*, w, v */
    vec G[NX * T];
} tile;

/* Where a label of vector 0 goes. */
INLINE vec *place(tile *s, int label)
{
    if (label < NF) return s->in[0] + label * LD;
    if (label < NF + NS) return s->slope + (label - NF) * T;
    if (label < NF + NS + NX) return s->V_x + (label - NF - NS) * T;
    return s->V + (label - NF - NS - NX) * T;
}

/* Rows at[0 .. n - 1] of the labels, a lane each; lanes beyond n repeat the last row. */
static void load(tile *s, const int64_t *at, int64_t n, const real *rows)
{
    for (int t = 0; t < T; ++t) {
        const int64_t own = t * LANES < n ? t * LANES : n - 1;
        for (int first = 0; first < LABELS; first += LANES) {
            vec x[LANES];
            load_square(at + own, n - own, LABELS, rows, first, x);
            for (int i = 0; i < LANES && first + i < LABELS; ++i) place(s, first + i)[t] = x[i];
        }
    }
}

/* Weights lie as W, b of each layer, then the skip; W of layer l (1 .. LAYERS) begins at offset(l), b behind it. */
INLINE int offset(int l)
{
    int at = 0;
    for (int k = 1; k < l; ++k) at += size[k] * (size[k - 1] + 1);
    return at;
}

/* x += A in, n columns; x and in in rows of LD. */
INLINE void add_product(int M, int K, const real *A, int sm, int sk, const vec *in, vec *x)
{
    vec more[WIDEST * T];
    product(M, K, A, sm, sk, T, LD, in, T, more);
    for (int m = 0; m < M; ++m)
        for (int t = 0; t < T; ++t) x[m * LD + t] += more[m * T + t];
}

/* y, the network's answer, into in[LAYERS] (with `tangent` 0), or its tangent (T). */
static void up(tile *s, const real *w, int tangent)
{
    for (int l = 1; l <= LAYERS; ++l) {
        const real *W = w + offset(l);
        vec *x = s->in[l] + tangent;
        product(size[l], size[l - 1], W, size[l - 1], 1, T, LD, s->in[l - 1] + tangent, LD, x);
        if (!tangent) add_bias(size[l], T, W + size[l] * size[l - 1], LD, x);
        if (l == LAYERS) break;
        for (int m = 0; m < size[l]; ++m)
            for (int t = 0; t < T; ++t) {
                vec *a = s->in[l] + m * LD + t;
                if (!tangent) { a[0] = v_tanh(a[0]); continue; }
                s->rate[l][m * T + t] = a[T];
                a[T] *= 1 - a[0] * a[0];
            }
    }
    add_product(size[LAYERS], NF, w + offset(LAYERS + 1), NF, 1, s->in[0] + tangent, s->in[LAYERS] + tangent);
}

/* dV/din of every layer into q, through tanh into out's second half; dV/dy = 2 y. */
static void slopes(tile *s, const real *w)
{
    vec *y = s->in[LAYERS], *r = s->out[LAYERS] + T;
    for (int m = 0; m < size[LAYERS]; ++m)
        for (int t = 0; t < T; ++t) r[m * LD + t] = 2 * y[m * LD + t];
    for (int l = LAYERS; l > 0; --l) {
        product(size[l - 1], size[l], w + offset(l), 1, size[l - 1], T, LD, s->out[l] + T, T, s->q[l - 1]);
        for (int m = 0; l > 1 && m < size[l - 1]; ++m)
            for (int t = 0; t < T; ++t) {
                const vec a = s->in[l - 1][m * LD + t];
                s->out[l - 1][m * LD + T + t] = s->q[l - 1][m * T + t] * (1 - a * a);
            }
    }
    vec more[NF * T];
    product(NF, size[LAYERS], w + offset(LAYERS + 1), 1, NF, T, LD, r, T, more);
    for (int i = 0; i < NF * T; ++i) s->q[0][i] += more[i];
}

/* The loss of the samples, their sum returned; dloss/dV into V[0], the direction g into in[0]'s second half. Lanes beyond
   `left` count nothing. Slope k is of feature row[k] in state column[k]. */
INLINE double errors(tile *s, const int64_t *row, const int64_t *column, int64_t left)
{
    vec off[T], total[T];
    for (int i = 0; i < NX * T; ++i) s->G[i] = -s->V_x[i];
    for (int k = 0; k < NS; ++k)
        for (int t = 0; t < T; ++t) s->G[column[k] * T + t] += s->q[0][row[k] * T + t] * s->slope[k * T + t];
    for (int t = 0; t < T; ++t) {
        total[t] = off[t] = (vec){0};
        for (int i = 0; i < NX; ++i) off[t] += s->G[i * T + t] * s->G[i * T + t];
        for (int m = 0; m < size[LAYERS]; ++m) total[t] += s->in[LAYERS][m * LD + t] * s->in[LAYERS][m * LD + t];
    }
    double sum = 0;
    for (int t = 0; t < T; ++t) {
        const vec w = s->V[T + t], v = s->V[2 * T + t], e = (total[t] - s->V[t]) * w;
        vec norm = e * e + v * off[t] + (real)(ROUND * ROUND), share = (vec){0};
        for (int lane = 0; lane < LANES && t * LANES + lane < left; ++lane) {
            norm[lane] = F(sqrt)(norm[lane]);
            sum += norm[lane];
            share[lane] = 1 / norm[lane];
        }
        s->V[t] = e * w * share;
        for (int i = 0; i < NX; ++i) s->G[i * T + t] *= v * share;
    }
    for (int f = 0; f < NF; ++f)
        for (int t = 0; t < T; ++t) s->in[0][f * LD + T + t] = (vec){0};
    for (int k = 0; k < NS; ++k)
        for (int t = 0; t < T; ++t)
            s->in[0][row[k] * LD + T + t] += s->G[column[k] * T + t] * s->slope[k * T + t];
    return sum;
}

/* The gradient in all weights, added to g, from dloss/dV in V[0] and the tangents. */
static void down(tile *s, const real *w, real *g)
{
    for (int m = 0; m < size[LAYERS]; ++m)
        for (int t = 0; t < T; ++t) {
            const vec *y = s->in[LAYERS] + m * LD + t;
            s->out[LAYERS][m * LD + t] = 2 * (s->V[t] * y[0] + y[T]);
        }
    outer(size[LAYERS], NF, 2 * T, LD, s->out[LAYERS], s->in[0], g + offset(LAYERS + 1));
    for (int l = LAYERS; l > 0; --l) {
        outer(size[l], size[l - 1], 2 * T, LD, s->out[l], s->in[l - 1], g + offset(l));
        add_sums(size[l], T, LD, s->out[l], g + offset(l) + size[l] * size[l - 1]);
        if (l == 1) break;
        vec *bar = s->out[l - 1];
        product(size[l - 1], size[l], w + offset(l), 1, size[l - 1], T, LD, s->out[l], LD, bar);
        for (int m = 0; m < size[l - 1]; ++m)
            for (int t = 0; t < T; ++t) {
                const vec a = s->in[l - 1][m * LD + t];
                const int i = m * T + t;
                bar[m * LD + t] = (bar[m * LD + t] - 2 * a * s->q[l - 1][i] * s->rate[l - 1][i]) * (1 - a * a);
            }
    }
}

enum { BLOCK = 256 };  /* rows of a block: a sum of its own, whichever thread takes it */

static int parameters(void) { return offset(LAYERS + 1) + size[LAYERS] * NF; }

/* bytes[0] = what nocl_value_loss needs as `work` for each block. */
void nocl_value_work(int64_t first_block, int64_t last_block, const int64_t *at, int64_t *bytes)
{
    (void)first_block, (void)last_block, (void)at;
    *bytes = sizeof(tile) + BYTES;
}

/* The sum of the loss over the rows of each block, at[0 .. n - 1] of the labels, and its gradient g, over n. */
void nocl_value_loss(int64_t first_block, int64_t last_block, const int64_t *at, int64_t n, const real *w,
                     const real *rows, const int64_t *row, const int64_t *column, char *work, real *g, double *loss)
{
    work += first_block * (sizeof(tile) + BYTES);  /* one tile for all blocks of a thread: it stays in the cache */
    tile *s = (tile *)(work + BYTES - (uintptr_t)work % BYTES);
    for (int64_t block = first_block; block < last_block; ++block) {
        const int64_t end = (block + 1) * BLOCK < n ? (block + 1) * BLOCK : n;
        real *own = g + block * parameters();
        loss[block] = 0;
        memset(own, 0, parameters() * sizeof(real));
        for (int64_t first = block * BLOCK; first < end; first += T * LANES) {
            const int64_t left = end - first, next = left - T * LANES;
            load(s, at + first, left, rows);
            prefetch(at + first + T * LANES, next < T * LANES ? next : T * LANES, LABELS, rows);
            up(s, w, 0);
            slopes(s, w);
            loss[block] += errors(s, row, column, left) / n;
            up(s, w, T);
            down(s, w, own);
        }
        for (int i = 0; i < parameters(); ++i) own[i] /= n;
    }
}

int64_t nocl_width(void) { return BLOCK; }
