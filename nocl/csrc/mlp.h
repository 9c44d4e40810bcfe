/* Multilayer perceptrons over lanes, with first and second derivatives with respect to their inputs.

   A layer's units carry C = 1 + d + d (d + 1) / 2 channels: value, gradient, upper triangle of the Hessian, row by row.
   Weights are one array: for each layer W [out, in] by rows, then b [out]; then W_skip [out, d] where there is a skip. */

static inline void activate(int kind, lane z, lane *f, lane *df, lane *ddf)
{
    if (kind == 0) { *f = v_sin(z); *df = v_cos(z); *ddf = -*f; }
    else if (kind == 1) { *f = v_tanh(z); *df = 1 - *f * *f; *ddf = -2 * *f * *df; }
    else if (kind == 2) { *f = where(z <= 0, (lane){0}, z); *df = truth(z > 0); *ddf = (lane){0}; }
    else { const lane s = 1 / (1 + v_exp(-z)); *f = z * s; *df = s * (1 + z * (1 - s));
           *ddf = s * (1 - s) * (2 + z * (1 - 2 * s)); }
}

/* y[out * C] = W a + b over all channels; four rows at a time share each load of a. */
static void affine(const double *w, int n_in, int n_out, int C, const lane *a, lane *y)
{
    const double *b = w + n_in * n_out;
    for (int o = 0; o < n_out; o += 4) {
        const int rows = n_out - o < 4 ? n_out - o : 4;
        for (int c = 0; c < C; ++c) {
            lane sum[4] = {{0}};
            for (int r = 0; r < rows; ++r) if (c == 0) sum[r] = splat(b[o + r]);
            if (rows == 4)
                for (int i = 0; i < n_in; ++i) {
                    const lane v = a[i * C + c];
                    for (int r = 0; r < 4; ++r) sum[r] += w[(o + r) * n_in + i] * v;
                }
            else
                for (int i = 0; i < n_in; ++i)
                    for (int r = 0; r < rows; ++r) sum[r] += w[(o + r) * n_in + i] * a[i * C + c];
            for (int r = 0; r < rows; ++r) y[(o + r) * C + c] = sum[r];
        }
    }
}

static void activate_all(int kind, int n, int d, int C, lane *y)
{
    for (int o = 0; o < n; ++o) {
        lane *row = y + o * C, f, df, ddf;
        activate(kind, row[0], &f, &df, &ddf);
        row[0] = f;
        if (C == 1) continue;
        for (int i = 0, c = 1 + d; i < d; ++i)
            for (int j = i; j < d; ++j, ++c) row[c] = df * row[c] + ddf * row[1 + i] * row[1 + j];
        for (int i = 0; i < d; ++i) row[1 + i] *= df;
    }
}

/* Values, and with order 2 gradients and Hessians; a and y are workspaces of (widest layer) * C. Returns where the
   answer stands: out * C. */
static const lane *mlp(const double *w, const int *sizes, int layers, int kind, int skip, int order,
                       const lane *phi, lane *a, lane *y)
{
    const int d = sizes[0], C = order ? 1 + d + d * (d + 1) / 2 : 1, out = sizes[layers];
    for (int i = 0; i < d; ++i)
        for (int c = 0; c < C; ++c) a[i * C + c] = c == 0 ? phi[i] : splat(c == 1 + i);
    for (int l = 0; l < layers; ++l) {
        affine(w, sizes[l], sizes[l + 1], C, a, y);
        w += (sizes[l] + 1) * sizes[l + 1];
        if (l + 1 < layers) activate_all(kind, sizes[l + 1], d, C, y);
        lane *swap = a;
        a = y;
        y = swap;
    }
    if (skip)
        for (int o = 0; o < out; ++o)
            for (int i = 0; i < d; ++i) {
                a[o * C] += w[o * d + i] * phi[i];
                if (order) a[o * C + 1 + i] += w[o * d + i];
            }
    return a;
}
