/* Vectors of samples, one a lane, and the matrix products of the compiled losses: sums over layers' weights, and of their
   gradients over lanes. The includer defines SINGLE (1: float, 0: double). Matrices of samples are rows of vectors, `ld`
   vectors apart; matrices of numbers are by rows. */
#include <math.h>
#include <stdint.h>
#include <string.h>

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
#define STRIP 8  /* rows, in `outer` */
#define INLINE static inline __attribute__((always_inline))

typedef real vec __attribute__((vector_size(BYTES)));

INLINE vec of(real value) { return value - (vec){0}; }
#if BYTES == 16 && !SINGLE
INLINE real sum_of(vec x) { return x[0] + x[1]; }
#else
typedef real quarter __attribute__((vector_size(BYTES / 4)));
INLINE real sum_of(vec x)
{
    union { vec whole; quarter parts[4]; } of = {x};
    const quarter four = (of.parts[0] + of.parts[1]) + (of.parts[2] + of.parts[3]);
    real sum = 0;
    for (int i = 0; i < LANES / 4; ++i) sum += four[i];
    return sum;
}
#endif

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

/* Labels lie by rows, filled with zeros up to a multiple of 16 numbers. */
#define STRIDE(labels) (((labels) + 15) / 16 * 16)

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

/* Labels first .. first + LANES - 1 of the rows at[0 .. LANES - 1], a lane each; rows beyond the n-th repeat that. */
INLINE void load_square(const int64_t *at, int64_t n, int labels, const real *rows, int first, vec x[LANES])
{
#pragma GCC unroll 16
    for (int lane = 0; lane < LANES; ++lane)
        memcpy(x + lane, rows + at[lane < n ? lane : n - 1] * STRIDE(labels) + first, sizeof(vec));
    transpose(x);
}

/* Asks for the labels of n rows to come: random rows of large arrays are not in any cache. */
static void prefetch(const int64_t *at, int64_t n, int labels, const real *rows)
{
    for (int64_t i = 0; i < n; ++i)
        for (size_t byte = 0; byte < labels * sizeof(real); byte += 64)
            __builtin_prefetch((const char *)(rows + at[i] * STRIDE(labels)) + byte);
}

INLINE void add_bias(int M, int columns, const real *b, int ld, vec *x)
{
    for (int m = 0; m < M; ++m)
        for (int t = 0; t < columns; ++t) x[m * ld + t] += b[m];
}

INLINE void add_sums(int M, int columns, int ld, const vec *bar, real *g)
{
    for (int m = 0; m < M; ++m) {
        vec sum = (vec){0};
        for (int t = 0; t < columns; ++t) sum += bar[m * ld + t];
        g[m] += sum_of(sum);
    }
}
