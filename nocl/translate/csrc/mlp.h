/* Multilayer perceptrons over lanes: values; slopes along q directions; then, for weights v on the outputs, the Hessian of
   v'y along the directions and its gradient with respect to the inputs.

   The Hessian takes one adjoint pass: v'y bends only where a unit does, so that with a_o the unit's argument, a_o' its slopes
   (kept in the tape) and g_o the adjoint of f(a_o), it is the sum over hidden units of g_o f''(a_o) a_o' a_o''. This costs
   2 + q products with each weight instead of the 1 + q + q (q + 1) / 2 of propagating every output's Hessian.

   Weights are one array: for each layer W [out, in] by rows, then b [out]; then W_skip [out, d] where there is a skip. */
#define ALWAYS static inline __attribute__((always_inline))

/* A unit's f(z), f'(z), f''(z). */
ALWAYS void activate(int kind, lane z, lane *f, lane *df, lane *ddf)
{
    if (kind == 0) { v_sincos(z, f, df); *ddf = -*f; }
    else if (kind == 1) { *f = v_tanh(z); *df = 1 - *f * *f; *ddf = -2 * *f * *df; }
    else if (kind == 2) { *f = where(z <= 0, (lane){0}, z); *df = truth(z > 0); *ddf = (lane){0}; }
    else { const lane s = 1 / (1 + v_exp(-z)); *f = z * s; *df = s * (1 + z * (1 - s));
           *ddf = s * (1 - s) * (2 + z * (1 - 2 * s)); }
}

ALWAYS void values_of(int kind, int n, lane *y)
{
    if (kind == 0)
        sines(n, y);
    else
        for (int o = 0; o < n; ++o) {
            lane df, ddf;
            activate(kind, y[o], y + o, &df, &ddf);
        }
}

/* y[r * C + c] = sum_i w[r * in + i] a[i * C + c] for R rows and D channels c; R D sums stay in registers. */
ALWAYS void block(int R, int D, const double *w, const double *b, int in, int C, const lane *a, lane *y)
{
    lane sum[8];
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 2
        for (int d = 0; d < D; ++d) sum[r * D + d] = b && d == 0 ? splat(b[r]) : (lane){0};
#pragma GCC unroll 8
    for (int i = 0; i < in; ++i) {
        const lane first = a[i * C], second = a[i * C + D - 1];
#pragma GCC unroll 8
        for (int r = 0; r < R; ++r) {
            const lane weight = splat(w[r * in + i]);
            sum[r * D] += weight * first;
            if (D == 2) sum[r * D + 1] += weight * second;
        }
    }
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 2
        for (int d = 0; d < D; ++d) y[r * C + d] = sum[r * D + d];
}

/* y = W a + (b, 0, ..., 0) over C channels: the value and C - 1 slopes. */
static void affine(const double *w, int in, int out, int C, const lane *a, lane *y)
{
    const double *b = w + in * out;
    for (int c = 0; c < C; c += 2) {
        int o = 0;
        if (c + 1 < C) {
            for (; o + 4 <= out; o += 4) block(4, 2, w + o * in, c ? 0 : b + o, in, C, a + c, y + o * C + c);
            for (; o < out; ++o) block(1, 2, w + o * in, c ? 0 : b + o, in, C, a + c, y + o * C + c);
        } else {
            for (; o + 8 <= out; o += 8) block(8, 1, w + o * in, c ? 0 : b + o, in, C, a + c, y + o * C + c);
            for (; o + 2 <= out; o += 2) block(2, 1, w + o * in, c ? 0 : b + o, in, C, a + c, y + o * C + c);
            for (; o < out; ++o) block(1, 1, w + o * in, c ? 0 : b + o, in, C, a + c, y + o * C + c);
        }
    }
}

/* g = W' v, the adjoint of affine's values, for R columns. */
ALWAYS void transposed_block(int R, const double *w, int in, int out, const lane *v, lane *g)
{
    lane sum[8];
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r) sum[r] = (lane){0};
#pragma GCC unroll 8
    for (int o = 0; o < out; ++o) {
#pragma GCC unroll 8
        for (int r = 0; r < R; ++r) sum[r] += w[o * in + r] * v[o];
    }
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r) g[r] = sum[r];
}

static void transposed(const double *w, int in, int out, const lane *v, lane *g)
{
    int i = 0;
    for (; i + 8 <= in; i += 8) transposed_block(8, w + i, in, out, v, g + i);
    for (; i + 2 <= in; i += 2) transposed_block(2, w + i, in, out, v, g + i);
    for (; i < in; ++i) transposed_block(1, w + i, in, out, v, g + i);
}

/* y[o * C] = values, o < out, from features phi [d]; a, b: workspaces of the widest layer. */
ALWAYS void mlp_values(const double *w, const int *sizes, int layers, int kind, int skip, int C, const lane *phi,
                       lane *a, lane *b, lane *y)
{
    const int d = sizes[0], out = sizes[layers];
    const lane *from = phi;
    for (int l = 0; l < layers; ++l) {
        lane *to = l % 2 ? b : a;
        affine(w, sizes[l], sizes[l + 1], 1, from, to);
        w += (sizes[l] + 1) * sizes[l + 1];
        if (l + 1 < layers) values_of(kind, sizes[l + 1], to);
        from = to;
    }
    for (int o = 0; o < out; ++o) {
        lane sum = from[o];
        if (skip) for (int i = 0; i < d; ++i) sum += w[o * d + i] * phi[i];
        y[o * C] = sum;
    }
}

/* y[o * C + c]: values (c = 0) and slopes along q = C - 1 directions, from features with theirs, phi[i * C + c]. Tape, a
   hidden unit after the other: f', f'' and the q slopes of the unit's argument. a, b: of the widest layer, times C. */
ALWAYS void mlp_slopes(const double *w, const int *sizes, int layers, int kind, int skip, int C, const lane *phi,
                       lane *tape, lane *a, lane *b, lane *y)
{
    const int d = sizes[0], out = sizes[layers];
    const lane *from = phi;
    for (int l = 0; l < layers; ++l) {
        lane *to = l % 2 ? b : a;
        affine(w, sizes[l], sizes[l + 1], C, from, to);
        w += (sizes[l] + 1) * sizes[l + 1];
        for (int o = 0; l + 1 < layers && o < sizes[l + 1]; ++o, tape += C + 1) {
            lane *unit = to + o * C, f, df, ddf;
            activate(kind, unit[0], &f, &df, &ddf);
            unit[0] = f;
            tape[0] = df;
            tape[1] = ddf;
            for (int c = 1; c < C; ++c) {
                const lane slope = unit[c];
                tape[1 + c] = slope;
                unit[c] = slope * df;
            }
        }
        from = to;
    }
    for (int o = 0; o < out; ++o)
        for (int c = 0; c < C; ++c) {
            lane sum = from[o * C + c];
            if (skip) for (int i = 0; i < d; ++i) sum += w[o * d + i] * phi[i * C + c];
            y[o * C + c] = sum;
        }
}

/* H[q (q + 1) / 2] += sum_o weight_o f''_o a_o' a_o'' over the n units of a tape, upper triangle by rows; work [n]. */
ALWAYS void bend_units(int n, int q, const lane *weight, const lane *tape, lane *work, lane *H)
{
    for (int i = 0; i < q; ++i) {
        for (int o = 0; o < n; ++o) work[o] = weight[o] * tape[o * (q + 2) + 1] * tape[o * (q + 2) + 2 + i];
        for (int j = i; j < q; ++j) {
            lane sum = {0};
            for (int o = 0; o < n; ++o) sum += work[o] * tape[o * (q + 2) + 2 + j];
            *H++ += sum;
        }
    }
}

/* For weights v [out]: H, the Hessian of v'y along the directions less what bends the features themselves, and s [d], the
   gradient of v'y with respect to the features. tape is mlp_slopes'; a, b, work: workspaces of the widest layer. */
ALWAYS void mlp_bend(const double *w, const int *sizes, int layers, int skip, int q, const lane *v, const lane *tape,
                     lane *a, lane *b, lane *work, lane *H, lane *s)
{
    const int d = sizes[0], out = sizes[layers];
    const lane *from = v;
    for (int i = 0; i < q * (q + 1) / 2; ++i) H[i] = (lane){0};
    for (int l = 0; l < layers; ++l) {
        w += (sizes[l] + 1) * sizes[l + 1];
        if (l) tape += sizes[l] * (q + 2);
    }
    const double *skipped = w;
    for (int l = layers - 1; l >= 0; --l) {
        const int n = sizes[l];
        lane *to = l == 0 ? s : l % 2 ? b : a;
        w -= (n + 1) * sizes[l + 1];
        transposed(w, n, sizes[l + 1], from, to);
        if (l) {
            tape -= n * (q + 2);
            bend_units(n, q, to, tape, work, H);
            for (int o = 0; o < n; ++o) to[o] *= tape[o * (q + 2)];
        }
        from = to;
    }
    if (skip)
        for (int i = 0; i < d; ++i)
            for (int o = 0; o < out; ++o) s[i] += skipped[o * d + i] * v[o];
}
