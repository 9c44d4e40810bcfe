/* Sines and cosines of all lanes at once, inline: errors below 3 units in the last place for |x| <= FAR, beyond it the C
   library's. Reduction by Cody and Waite (products of n < 2^20 with 33-bit parts of pi are exact), then polynomials:
   fdlibm's on [-pi/4, pi/4], Taylor's of degree 21 (error below 2e-17) on [-pi/2, pi/2]. */
#define FAR 8e5
#define ROUNDING 6755399441055744.0  /* 1.5 * 2^52: adding it leaves the nearest integer in the low bits */

static inline mask far_away(lane x) { return ~((x <= splat(FAR)) & (x >= splat(-FAR))); }

/* r = x - n * half_pi * (1 or 2), n the nearest integer; returns n in the low bits. */
static inline mask reduced(lane x, double halves, lane *r)
{
    const lane shifted = x * (6.36619772367581382433e-01 / halves) + ROUNDING, n = shifted - ROUNDING;
    *r = x - n * (halves * 1.57079632673412561417e+00);
    *r = *r - n * (halves * 6.07710050630396597660e-11);
    *r = *r - n * (halves * 2.02226624879595063154e-21);
    return bits(shifted);
}

static inline lane sine_near(lane x)
{
    lane r;
    const mask n = reduced(x, 2, &r);
    const lane s = r * r;
    lane p = s * (1 / 51090942171709440000.0) - 1 / 121645100408832000.0;
    p = p * s + 1 / 355687428096000.0;
    p = p * s - 1 / 1307674368000.0;
    p = p * s + 1 / 6227020800.0;
    p = p * s - 1 / 39916800.0;
    p = p * s + 1 / 362880.0;
    p = p * s - 1 / 5040.0;
    p = p * s + 1 / 120.0;
    p = p * s - 1 / 6.0;
    return (lane)(bits(r + r * (s * p)) ^ (n << 63));
}

static inline void sincos_near(lane x, lane *sine, lane *cosine)
{
    lane r;
    const mask n = reduced(x, 1, &r), odd = -(n & 1);
    const lane s = r * r;
    lane p = s * 1.58969099521155010221e-10 - 2.50507602534068634195e-08, q = s * -1.13596475577881948265e-11
        + 2.08757232129817482790e-09;
    p = p * s + 2.75573137070700676789e-06;
    q = q * s - 2.75573143513906633035e-07;
    p = p * s - 1.98412698298579493134e-04;
    q = q * s + 2.48015872894767294178e-05;
    p = p * s + 8.33333333332248946124e-03;
    q = q * s - 1.38888888888741095749e-03;
    p = p * s - 1.66666666666666324348e-01;
    q = q * s + 4.16666666666666019037e-02;
    const lane S = r + r * (s * p), C = 1 - (0.5 * s - s * (s * q));
    *sine = (lane)(bits(where(odd, C, S)) ^ ((n & 2) << 62));
    *cosine = (lane)(bits(where(odd, S, C)) ^ (((n + 1) & 2) << 62));
}

/* Replaces the lanes that are far away, NaN and infinite ones among them, by the C library's answers. */
static __attribute__((noinline, cold)) void sincos_far(lane x, mask far, lane *sine, lane *cosine)
{
    for (int i = 0; i < WIDTH; ++i)
        if (far[i]) {
            (*sine)[i] = sin(x[i]);
            (*cosine)[i] = cos(x[i]);
        }
}

static inline lane v_sin(lane x)
{
    lane y = sine_near(x), unused = {0};
    const mask far = far_away(x);
    if (__builtin_expect(any_lane(far), 0)) sincos_far(x, far, &y, &unused);
    return y;
}

/* y = sin(y), one look for far ones among all n. */
static inline void sines(int n, lane *y)
{
    mask far = {0};
#pragma GCC unroll 4
    for (int i = 0; i < n; ++i) far |= far_away(y[i]);
    if (__builtin_expect(any_lane(far), 0))
        for (int i = 0; i < n; ++i) y[i] = v_sin(y[i]);
    else
#pragma GCC unroll 4
        for (int i = 0; i < n; ++i) y[i] = sine_near(y[i]);
}

static inline void v_sincos(lane x, lane *sine, lane *cosine)
{
    lane s, c;
    const mask far = far_away(x);
    sincos_near(x, &s, &c);
    if (__builtin_expect(any_lane(far), 0)) sincos_far(x, far, &s, &c);
    *sine = s;
    *cosine = c;
}

static inline lane v_cos(lane x) { lane s, c; v_sincos(x, &s, &c); return c; }
