/* Lanes: a vector of WIDTH doubles, one problem of the batch in each; the widest that this machine has. */
#include <math.h>
#include <stdint.h>
#if defined(__AVX2__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
#define WIDTH 8
#define MVEC(name) _ZGVeN8v_##name
#define MVEC2(name) _ZGVeN8vv_##name
#elif defined(__AVX2__)
#define WIDTH 4
#define MVEC(name) _ZGVdN4v_##name
#define MVEC2(name) _ZGVdN4vv_##name
#else
#define WIDTH 2
#define MVEC(name) _ZGVbN2v_##name
#define MVEC2(name) _ZGVbN2vv_##name
#endif

typedef double lane __attribute__((vector_size(8 * WIDTH)));
typedef int64_t mask __attribute__((vector_size(8 * WIDTH)));

static inline lane splat(double value) { return value - (lane){0}; }
static inline mask bits(lane x) { return (mask)x; }
static inline lane where(mask m, lane a, lane b) { return (lane)((m & bits(a)) | (~m & bits(b))); }
static inline lane truth(mask m) { return (lane)(m & bits(splat(1.0))); }
static inline mask is_finite(lane x) { return (x - x) == (lane){0}; }
static inline mask all_lanes(void) { return (lane){0} == (lane){0}; }
static inline int any_lane(mask m)
{
#if defined(__AVX512DQ__)
    return _mm512_movepi64_mask((__m512i)m) != 0;
#elif defined(__AVX2__) && !defined(__AVX512F__)
    return _mm256_movemask_pd((__m256d)m) != 0;
#else
    int64_t any = 0;
    for (int i = 0; i < WIDTH; ++i) any |= m[i];
    return any != 0;
#endif
}

#define ONE_BY_ONE(name) static inline lane v_##name(lane x) { \
    lane y; for (int i = 0; i < WIDTH; ++i) y[i] = name(x[i]); return y; }
#define TWO_BY_TWO(name) static inline lane v_##name(lane x, lane y) { \
    lane z; for (int i = 0; i < WIDTH; ++i) z[i] = name(x[i], y[i]); return z; }
#ifdef WITH_MVEC  /* the C library's vector functions, at most 4 units in the last place */
#define AT_ONCE(name) extern lane MVEC(name)(lane); static inline lane v_##name(lane x) { return MVEC(name)(x); }
#define AT_ONCE2(name) extern lane MVEC2(name)(lane, lane); \
    static inline lane v_##name(lane x, lane y) { return MVEC2(name)(x, y); }
#else
#define AT_ONCE ONE_BY_ONE
#define AT_ONCE2 TWO_BY_TWO
#endif

AT_ONCE(tan) AT_ONCE(asin) AT_ONCE(acos) AT_ONCE(atan)
AT_ONCE(sinh) AT_ONCE(cosh) AT_ONCE(tanh) AT_ONCE(asinh) AT_ONCE(acosh) AT_ONCE(atanh)
AT_ONCE(exp) AT_ONCE(log) AT_ONCE(expm1) AT_ONCE(log1p) AT_ONCE(erf)
AT_ONCE2(pow) AT_ONCE2(atan2) AT_ONCE2(hypot)
ONE_BY_ONE(sqrt) ONE_BY_ONE(fabs) ONE_BY_ONE(floor) ONE_BY_ONE(ceil)
TWO_BY_TWO(fmod) TWO_BY_TWO(remainder) TWO_BY_TWO(copysign) TWO_BY_TWO(fmin) TWO_BY_TWO(fmax)
static inline lane v_sign(lane x) { return where(x != x, x, truth(x > 0) - truth(x < 0)); }

#include "trig.h"

/* Problem-major arrays [B, stride], read and written for the problems at[0..WIDTH-1]. */
static inline lane gather(const double *array, const int64_t *at, int64_t stride, int64_t offset)
{
    lane x;
    for (int i = 0; i < WIDTH; ++i) x[i] = array[at[i] * stride + offset];
    return x;
}
static inline void scatter(double *array, const int64_t *at, int64_t stride, int64_t offset, lane x)
{
    for (int i = 0; i < WIDTH; ++i) array[at[i] * stride + offset] = x[i];
}

int64_t nocl_width(void) { return WIDTH; }
