/* The paper's identification loss of a three-layer MLP and its gradient, over a batch: values and full Jacobians.

   The includer defines SINGLE (1: float, 0: double), NZ, NX, H (sizes), CURVE (SINE, TANH, RELU or SILU) and, if the
   norms below are to be squared, SQUARED 1. With
   t1 = W1 z + b1, a1 = s(t1), t2 = W2 a1 + b2, a2 = s(t2), y = W3 a2 + b3, D = diag s'(t), the loss of a sample is
   |S (y - f)| + |S_J * (J - df/dz)|, J = W3 D2 W2 D1 W1, entry by entry: what is normalised is weighed in physical
   units by scale [NX + NX NZ], first S, then S_J by rows. One sample a vector lane; a tile is T vectors of samples, few
   enough to stay in the cache. Matrices of a tile are [rows][T] or, of the Jacobian's part, [rows][C] in rows of LD:
   column o T + t is equation o of vector t. The T columns after these are the values' in G1 (a1) and G2 (the adjoint of
   t2), so that W2's gradient is one product. J is built from the output down, its gradient from the input up. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define SINE 0
#define TANH 1
#define RELU 2
#define SILU 3

#ifndef SQUARED
#define SQUARED 0
#endif
#if SINGLE
typedef float real;
#define F(name) name##f
#else
typedef double real;
#define F(name) name
#endif
#if defined(__AVX512F__)
#define BYTES 64
#define MVEC(name) F3(_ZGVeN, 16, 8, name)
#elif defined(__AVX2__)
#define BYTES 32
#define MVEC(name) F3(_ZGVdN, 8, 4, name)
#else
#define BYTES 16
#define MVEC(name) F3(_ZGVbN, 4, 2, name)
#endif
#if SINGLE
#define F3(isa, single, twice, name) isa##single##v_##name##f
#else
#define F3(isa, single, twice, name) isa##twice##v_##name
#endif
#define LANES ((int)(BYTES / sizeof(real)))
#define T (NX <= 12 ? 4 : NX <= 24 ? 2 : 1)
#define C (NX * T)
#define LD ((C + T) | 1)  /* an odd number of vectors between rows: powers of two share the cache's few sets */
#define STRIP 8  /* rows, in `outer` */
#define INLINE static inline __attribute__((always_inline))

typedef real vec __attribute__((vector_size(BYTES)));

INLINE vec of(real value) { return value - (vec){0}; }
typedef real quarter __attribute__((vector_size(BYTES / 4)));
INLINE real sum_of(vec x)
{
    union { vec whole; quarter parts[4]; } of = {x};
    const quarter four = (of.parts[0] + of.parts[1]) + (of.parts[2] + of.parts[3]);
    real sum = 0;
    for (int i = 0; i < LANES / 4; ++i) sum += four[i];
    return sum;
}

#if BYTES == 64 && SINGLE
#define EVEN {0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30}
#elif BYTES == 64 || (BYTES == 32 && SINGLE)
#define EVEN {0, 2, 4, 6, 8, 10, 12, 14}
#elif BYTES == 32 || SINGLE
#define EVEN {0, 2, 4, 6}
#else
#define EVEN {0, 2}
#endif
#if SINGLE
typedef int32_t lanes __attribute__((vector_size(BYTES)));
#else
typedef int64_t lanes __attribute__((vector_size(BYTES)));
#endif

/* The sums over lanes of 16 vectors, at once: neighbouring lanes of pairs of vectors are added until one is left. */
INLINE void sums_of(vec x[16], real total[16])
{
    const lanes even = EVEN, odd = even + 1;
#pragma GCC unroll 4
    for (int n = 8; n >= 16 / LANES; n /= 2)
#pragma GCC unroll 8
        for (int i = 0; i < n; ++i)
            x[i] = __builtin_shuffle(x[2 * i], x[2 * i + 1], even) + __builtin_shuffle(x[2 * i], x[2 * i + 1], odd);
    memcpy(total, x, 16 * sizeof(real));
}

#ifdef WITH_MVEC
#define EACH(name) extern vec MVEC(name)(vec); static inline vec v_##name(vec x) { return MVEC(name)(x); }
#else
#define EACH(name) static inline vec v_##name(vec x) { \
    vec y; for (int i = 0; i < LANES; ++i) y[i] = F(name)(x[i]); return y; }
#endif
EACH(sin) EACH(cos) EACH(tanh) EACH(exp)

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

/* out[m][c] = sum_k A[m, k] in[k][c], A[m, k] at A[m * sm + k * sk], for a rows x columns block in registers; rows of
   in and out are ldi and ldo vectors apart. */
INLINE void product_block(int rows, int columns, int K, const real *A, int sm, int sk, int ldi, const vec *in, int ldo,
                          vec *out)
{
    vec sum[4][4];
#pragma GCC unroll 4
    for (int m = 0; m < rows; ++m)
#pragma GCC unroll 4
        for (int c = 0; c < columns; ++c) sum[m][c] = (vec){0};
#pragma GCC unroll 2
    for (int k = 0; k < K; ++k)
#pragma GCC unroll 4
        for (int m = 0; m < rows; ++m) {
            const vec a = of(A[m * sm + k * sk]);
#pragma GCC unroll 4
            for (int c = 0; c < columns; ++c) sum[m][c] += a * in[k * ldi + c];
        }
#pragma GCC unroll 4
    for (int m = 0; m < rows; ++m)
#pragma GCC unroll 4
        for (int c = 0; c < columns; ++c) out[m * ldo + c] = sum[m][c];
}

INLINE void product_columns(int columns, int M, int K, const real *A, int sm, int sk, int ldi, const vec *in, int ldo,
                            vec *out)
{
    int m = 0;
    for (; m + 4 <= M; m += 4) product_block(4, columns, K, A + m * sm, sm, sk, ldi, in, ldo, out + m * ldo);
    for (; M % 4 && m < M; ++m) product_block(1, columns, K, A + m * sm, sm, sk, ldi, in, ldo, out + m * ldo);
}

/* Of n columns. */
INLINE void product(int M, int K, const real *A, int sm, int sk, int n, int ldi, const vec *in, int ldo, vec *out)
{
    int c = 0;
    for (; c + 4 <= n; c += 4) product_columns(4, M, K, A, sm, sk, ldi, in + c, ldo, out + c);
    for (; n % 4 && c < n; ++c) product_columns(1, M, K, A, sm, sk, ldi, in + c, ldo, out + c);
}

/* gradient[m, k] += the sum over lanes and columns of left[m][c] right[k][c]; gradient [M, K] by rows. */
INLINE void outer_block(int rows, int columns, int K, int n, int ld, const vec *left, const vec *right, real *gradient)
{
    vec sum[16];
    real total[16];
#pragma GCC unroll 16
    for (int i = 0; i < 16; ++i) sum[i] = (vec){0};
#pragma GCC unroll 2
    for (int c = 0; c < n; ++c)
#pragma GCC unroll 4
        for (int m = 0; m < rows; ++m)
#pragma GCC unroll 4
            for (int k = 0; k < columns; ++k) sum[4 * m + k] += left[m * ld + c] * right[k * ld + c];
    if (rows * columns < 4) {
        for (int m = 0; m < rows; ++m)
            for (int k = 0; k < columns; ++k) gradient[m * K + k] += sum_of(sum[4 * m + k]);
        return;
    }
    sums_of(sum, total);
#pragma GCC unroll 4
    for (int m = 0; m < rows; ++m)
#pragma GCC unroll 4
        for (int k = 0; k < columns; ++k) gradient[m * K + k] += total[4 * m + k];
}

INLINE void outer_rows(int rows, int columns, int K, int n, int ld, const vec *left, const vec *right, real *gradient)
{
    int k = 0;
    for (; k + 4 <= columns; k += 4) outer_block(rows, 4, K, n, ld, left, right + k * ld, gradient + k);
    for (; columns % 4 && k < columns; ++k) outer_block(rows, 1, K, n, ld, left, right + k * ld, gradient + k);
}

/* In strips of the right side that stay in the nearest cache while the left side's rows pass. */
INLINE void outer(int M, int K, int n, int ld, const vec *left, const vec *right, real *gradient)
{
    for (int k = 0; k < K; k += STRIP) {
        const int columns = K - k < STRIP ? K - k : STRIP;
        int m = 0;
        for (; m + 4 <= M; m += 4)
            outer_rows(4, columns, K, n, ld, left + m * ld, right + k * ld, gradient + m * K + k);
        for (; M % 4 && m < M; ++m)
            outer_rows(1, columns, K, n, ld, left + m * ld, right + k * ld, gradient + m * K + k);
    }
}

/* Labels lie by rows: z, f, df/dz by rows, then zeros up to a multiple of 16 numbers. */
enum { VALUES = NZ + NX, ALL = VALUES + NX * NZ };
#define STRIDE(labels) (((labels) + 15) / 16 * 16)

/* W1 [H, NZ], b1, W2 [H, H], b2, W3 [NX, H], b3, in this order in one array. */
enum { B1 = H * NZ, W2 = B1 + H, B2 = W2 + H * H, W3 = B2 + H, B3 = W3 + NX * H, PARAMETERS = B3 + NX };

typedef struct {
    vec z[NZ * T], f[NX * T], dfdz[NZ * LD];  /* labels; dfdz[i][o T + t] */
    vec d1[H * T], e1[H * T], a2[H * T], d2[H * T], e2[H * T], y[NX * T];
    vec G2[H * LD], P[H * LD], G1[H * LD], J[NZ * LD];  /* dy/dt2, dy/da1, dy/dt1, dy/dz */
    vec t1_bar[H * T], d1_bar[H * T], d2_bar[H * T];
} tile;

/* Of a square of numbers, a row a vector, by perfect shuffles: each turns the binary number of every place by a bit. */
INLINE void transpose(vec x[LANES])
{
    lanes low, high;
    for (int i = 0; i < LANES; ++i) low[i] = i / 2 + i % 2 * LANES;
    high = low + LANES / 2;
#pragma GCC unroll 4
    for (int step = 1; step < LANES; step *= 2) {
        vec y[LANES];
#pragma GCC unroll 8
        for (int i = 0; i < LANES / 2; ++i) {
            y[2 * i] = __builtin_shuffle(x[i], x[i + LANES / 2], low);
            y[2 * i + 1] = __builtin_shuffle(x[i], x[i + LANES / 2], high);
        }
#pragma GCC unroll 16
        for (int i = 0; i < LANES; ++i) x[i] = y[i];
    }
}

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
        const real *own[LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const int64_t i = t * LANES + lane;
            own[lane] = rows + at[i < n ? i : n - 1] * STRIDE(labels);
        }
        for (int first = 0; first < labels; first += LANES) {
            vec x[LANES];
#pragma GCC unroll 16
            for (int lane = 0; lane < LANES; ++lane) memcpy(x + lane, own[lane] + first, sizeof(vec));
            transpose(x);
            for (int i = 0; i < LANES && first + i < labels; ++i) place(s, first + i)[t] = x[i];
        }
    }
}

/* Asks for the labels of the tile to come: random rows of large arrays are not in any cache. */
static void prefetch(const int64_t *at, int64_t n, int labels, const real *rows)
{
    for (int64_t i = 0; i < n && i < T * LANES; ++i)
        for (size_t byte = 0; byte < labels * sizeof(real); byte += 64)
            __builtin_prefetch((const char *)(rows + at[i] * STRIDE(labels)) + byte);
}

INLINE void add_bias(int M, const real *b, int ld, vec *x)
{
    for (int m = 0; m < M; ++m)
        for (int t = 0; t < T; ++t) x[m * ld + t] += b[m];
}

static void values(tile *s, const real *w)
{
    vec *a1 = s->G1 + C;
    product(H, NZ, w, NZ, 1, T, T, s->z, LD, a1);
    add_bias(H, w + B1, LD, a1);
    curve(H, LD, a1, s->d1, s->e1);
    product(H, H, w + W2, H, 1, T, LD, a1, T, s->a2);
    add_bias(H, w + B2, T, s->a2);
    curve(H, T, s->a2, s->d2, s->e2);
    product(NX, H, w + W3, H, 1, T, T, s->a2, T, s->y);
    add_bias(NX, w + B3, T, s->y);
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

INLINE void add_sums(int M, int ld, const vec *bar, real *g)
{
    for (int m = 0; m < M; ++m) {
        vec sum = (vec){0};
        for (int t = 0; t < T; ++t) sum += bar[m * ld + t];
        g[m] += sum_of(sum);
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
    add_sums(NX, T, s->y, g + B3);
    product(H, NX, w + W3, 1, H, T, T, s->y, LD, t2_bar);
    through_curve(LD, t2_bar, s->d2, s->d2_bar, s->e2, with_jacobian);
    if (with_jacobian) outer(H, H, C + T, LD, s->G2, s->G1, g + W2);
    else outer(H, H, T, LD, t2_bar, a1, g + W2);
    add_sums(H, LD, t2_bar, g + B2);
    product(H, H, w + W2, 1, H, T, LD, t2_bar, T, s->t1_bar);
    through_curve(T, s->t1_bar, s->d1, s->d1_bar, s->e1, with_jacobian);
    outer(H, NZ, T, T, s->t1_bar, s->z, g);
    add_sums(H, T, s->t1_bar, g + B1);
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
        prefetch(at + first + T * LANES, left - T * LANES, labels, rows);
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
