/* Runs of a policy as continuous feedback: RK4 on (x, t, integral of L), `steps` of each problem's own length.

   policy_net(weights, z, u), field(z, u, xdot) or field_net(weights, z, u, xdot), cost(z, u, L) are generated, of
   z = (x, t, p). Problems are rows (x0, t0, h, p); path [B, steps+1, N], J [B]. */
static void loop_field(const double *pi, const double *theta, const lane *z, lane *slope)
{
    lane u[M];
    policy_net(pi, z, u);
#if LEARNED
    field_net(theta, z, u, slope);
#else
    (void)theta;
    field(z, u, slope);
#endif
    cost(z, u, slope + N);
}

void nocl_closed_loop(int64_t first, int64_t last, const int64_t *index, const int64_t *steps, const double *pi,
                      const double *theta, const double *start, double *path, double *J)
{
    static const double reach[4] = {0, 0.5, 0.5, 1}, share[4] = {1. / 6, 1. / 3, 1. / 3, 1. / 6};
    const int64_t K = *steps, row = N + 2 + NP;
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane x[N], z[N + 1 + NP], slope[N + 1] = {{0}}, sum[N + 1], total = {0};
        const lane t0 = gather(start, at, row, N), h = gather(start, at, row, N + 1);
        for (int i = 0; i < N; ++i) {
            x[i] = gather(start, at, row, i);
            scatter(path, at, (K + 1) * N, i, x[i]);
        }
        for (int i = 0; i < NP; ++i) z[N + 1 + i] = gather(start, at, row, N + 2 + i);
        for (int64_t k = 0; k < K; ++k) {
            for (int i = 0; i <= N; ++i) sum[i] = (lane){0};
            for (int s = 0; s < 4; ++s) {
                for (int i = 0; i < N; ++i) z[i] = x[i] + reach[s] * h * slope[i];
                z[N] = t0 + h * (k + reach[s]);
                loop_field(pi, theta, z, slope);
                for (int i = 0; i <= N; ++i) sum[i] += share[s] * slope[i];
            }
            for (int i = 0; i < N; ++i) {
                x[i] += h * sum[i];
                scatter(path, at, (K + 1) * N, (k + 1) * N + i, x[i]);
            }
            total += h * sum[N];
        }
        scatter(J, at, 1, 0, total);
    }
}
