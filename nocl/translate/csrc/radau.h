/* One step of Radau IIA, for the kernel of ddp.h:

   X_i = x + h sum_j weight[i][j] f(X_j, u, t + reach[j] h),  x+ = X_last,  cost = h sum_j weight[last][j] L(X_j, u, t + reach[j] h)

   Generated before this file: STAGES, NEWTON (iterations at most), reach, weight, UNIT[N] (a usual size of each state), and tables
   of patterns, row by row (row r: X_ROW[r] to X_ROW[r+1], columns X_COL): J_ of d(xdot, L)/d(x, u), N + 1 rows; W_ of a stage's
   Hessian, whole, with W_AT the place among its NW nonzeros.

   Unknowns are Z_i = X_i - x, and all that is eliminated is in UNITs: A = I - h weight x df/dx. Lanes do not look at each other:
   one that has converged rests while others go on. */
#define NS (STAGES * N)
#define SETTLED 1e-9  /* of Z, by Newton's last correction: what is left is of the order of its square */

static inline lane magnitude(lane x) { return where(x < 0, -x, x); }

/* A from the stages' Jacobians. */
static void newton_matrix(const lane *J, lane h, lane A[NS][NS])
{
    for (int i = 0; i < NS; ++i)
        for (int j = 0; j < NS; ++j) A[i][j] = splat(i == j);
    for (int i = 0; i < STAGES; ++i)
        for (int j = 0; j < STAGES; ++j) {
            const lane a = h * weight[i][j];
            for (int r = 0; r < N; ++r)
                for (int p = J_ROW[r]; p < J_ROW[r + 1]; ++p)
                    if (J_COL[p] < N) A[i * N + r][j * N + J_COL[p]] -= a * J[j * NJ + p] * (UNIT[J_COL[p]] / UNIT[r]);
        }
}

/* A's triangular factors in its place, the diagonal inverted; swaps[c][r]: where rows c and r changed places at column c. */
static void factors(lane A[NS][NS], mask swaps[NS][NS])
{
    for (int c = 0; c < NS; ++c) {
        for (int r = c + 1; r < NS; ++r) {
            swaps[c][r] = magnitude(A[r][c]) > 2 * magnitude(A[c][c]);
            if (any_lane(swaps[c][r]))
                for (int j = c; j < NS; ++j) {
                    const lane upper = A[c][j];
                    A[c][j] = where(swaps[c][r], A[r][j], upper);
                    A[r][j] = where(swaps[c][r], upper, A[r][j]);
                }
        }
        A[c][c] = 1 / A[c][c];
        for (int r = c + 1; r < NS; ++r) {
            const lane share = A[r][c] * A[c][c];
            A[r][c] = share;
            for (int j = c + 1; j < NS; ++j) A[r][j] -= share * A[c][j];
        }
    }
}

static inline void swap_rows(mask where_, lane *a, lane *b, int columns)
{
    if (!any_lane(where_)) return;
    for (int k = 0; k < columns; ++k) {
        const lane first = a[k];
        a[k] = where(where_, b[k], first);
        b[k] = where(where_, first, b[k]);
    }
}

/* A X = X for X [NS, columns], in place. */
static void solve(lane A[NS][NS], mask swaps[NS][NS], int columns, lane *X)
{
    for (int c = 0; c < NS; ++c) {
        for (int r = c + 1; r < NS; ++r) swap_rows(swaps[c][r], X + c * columns, X + r * columns, columns);
        for (int r = c + 1; r < NS; ++r)
            for (int k = 0; k < columns; ++k) X[r * columns + k] -= A[r][c] * X[c * columns + k];
    }
    for (int r = NS - 1; r >= 0; --r)
        for (int k = 0; k < columns; ++k) {
            lane sum = X[r * columns + k];
            for (int j = r + 1; j < NS; ++j) sum -= A[r][j] * X[j * columns + k];
            X[r * columns + k] = sum * A[r][r];
        }
}

/* A' y = y, in place. */
static void solve_transposed(lane A[NS][NS], mask swaps[NS][NS], lane *y)
{
    for (int r = 0; r < NS; ++r) {
        for (int j = 0; j < r; ++j) y[r] -= A[j][r] * y[j];
        y[r] *= A[r][r];
    }
    for (int c = NS - 1; c >= 0; --c) {
        for (int r = c + 1; r < NS; ++r) y[c] -= A[r][c] * y[r];
        for (int r = NS - 1; r > c; --r) swap_rows(swaps[c][r], y + c, y + r, 1);
    }
}

/* The state at stage j. */
static inline void stage_state(const lane *x, const lane *Z, int j, lane *X)
{
    for (int i = 0; i < N; ++i) X[i] = x[i] + Z[j * N + i];
}

/* Z by Newton's method from 0; returns where it converged. */
static mask stages(const double *weights, const lane *x, const lane *u, DATA_IN lane h, lane *Z)
{
    lane J[STAGES * NJ + 1], k[STAGES][N + 1], net[NET + 1], tape[TAPE + 1], X[N], A[NS][NS], R[NS];
    mask swaps[NS][NS], busy = all_lanes(), done = {0};
    for (int i = 0; i < NS; ++i) Z[i] = (lane){0};
    for (int iteration = 0; iteration < NEWTON && any_lane(busy); ++iteration) {
        for (int j = 0; j < STAGES; ++j) {
            stage_state(x, Z, j, X);
            LATER(d, reach[j] * h, now)
            network_slopes(weights, X, u, NOW net, tape);
            field(X, u, NOW net, k[j]);
            stage_jacobian(X, u, NOW net, J + j * NJ);
        }
        newton_matrix(J, h, A);
        factors(A, swaps);
        for (int i = 0; i < STAGES; ++i)
            for (int r = 0; r < N; ++r) {
                lane sum = Z[i * N + r];
                for (int j = 0; j < STAGES; ++j) sum -= h * weight[i][j] * k[j][r];
                R[i * N + r] = sum / UNIT[r];
            }
        solve(A, swaps, 1, R);
        lane most = {0};
        for (int i = 0; i < NS; ++i) {
            const lane size = magnitude(R[i]) / (1 + magnitude(x[i % N] + Z[i]) / UNIT[i % N]);
            most = where(size <= most, most, size);  /* NaN stays */
            Z[i] = where(busy, Z[i] - UNIT[i % N] * R[i], Z[i]);
        }
        done |= busy & (most <= SETTLED);
        busy &= (most > SETTLED) & is_finite(most);
    }
    return done;
}

/* x to next; returns the cost, NaN where Newton's method did not converge. */
static lane step(const double *weights, const lane *x, const lane *u, DATA_IN lane h, lane *next)
{
    lane Z[NS], X[N], k[N + 1], net[NET + 1], cost = {0};
    const mask done = stages(weights, x, u, DATA h, Z);
    for (int j = 0; j < STAGES; ++j) {
        stage_state(x, Z, j, X);
        LATER(d, reach[j] * h, now)
        network_values(weights, X, u, NOW net);
        field(X, u, NOW net, k);
        cost += weight[STAGES - 1][j] * h * k[N];
    }
    for (int i = 0; i < N; ++i) next[i] = where(done, X[i], splat(NAN));
    return where(done, cost, splat(NAN));
}

/* S[STAGES][NZ][NZ] = d(state at a stage, u)/d(x, u), from A's factors. */
static void stage_slopes(const lane *J, lane h, lane A[NS][NS], mask swaps[NS][NS], lane S[STAGES][NZ][NZ])
{
    lane right[NS][NZ];
    for (int i = 0; i < NS; ++i)
        for (int c = 0; c < NZ; ++c) right[i][c] = splat((c == i % N) / UNIT[i % N]);
    for (int i = 0; i < STAGES; ++i)
        for (int j = 0; j < STAGES; ++j)
            for (int r = 0; r < N; ++r)
                for (int p = J_ROW[r]; p < J_ROW[r + 1]; ++p)
                    if (J_COL[p] >= N) right[i * N + r][J_COL[p]] += h * weight[i][j] * J[j * NJ + p] / UNIT[r];
    solve(A, swaps, NZ, right[0]);
    for (int j = 0; j < STAGES; ++j)
        for (int r = 0; r < NZ; ++r)
            for (int c = 0; c < NZ; ++c) S[j][r][c] = r < N ? UNIT[r] * right[j * N + r][c] : splat(r == c);
}

/* mu[j (N+1)], what weights (xdot, L) at stage j in lam'x+ + cost, from A's factors. */
static void stage_weights(const lane *J, const lane *lam, lane h, lane A[NS][NS], mask swaps[NS][NS], lane *mu)
{
    lane nu[NS];  /* multipliers of the stages' equations */
    for (int j = 0; j < STAGES; ++j) {
        lane *at = nu + j * N;
        for (int r = 0; r < N; ++r) at[r] = j == STAGES - 1 ? lam[r] : (lane){0};
        for (int p = J_ROW[N]; p < J_ROW[N + 1]; ++p)
            if (J_COL[p] < N) at[J_COL[p]] += h * weight[STAGES - 1][j] * J[j * NJ + p];
        for (int r = 0; r < N; ++r) at[r] *= UNIT[r];
    }
    solve_transposed(A, swaps, nu);
    for (int j = 0; j < STAGES; ++j) {
        for (int r = 0; r < N; ++r) {
            lane sum = {0};
            for (int i = 0; i < STAGES; ++i) sum += weight[i][j] * nu[i * N + r] / UNIT[r];
            mu[j * (N + 1) + r] = h * sum;
        }
        mu[j * (N + 1) + N] = h * weight[STAGES - 1][j];
    }
}

/* H += S' W S, lower triangle. */
static void congruence(const lane *W, lane S[NZ][NZ], lane *H)
{
    for (int r = 0; r < NZ; ++r) {
        lane T[NZ];
        for (int c = 0; c < NZ; ++c) T[c] = (lane){0};
        for (int p = W_ROW[r]; p < W_ROW[r + 1]; ++p) {
            const lane w = W[W_AT[p]];
            if (W_COL[p] >= N) T[W_COL[p]] += w;
            else for (int c = 0; c < NZ; ++c) T[c] += w * S[W_COL[p]][c];
        }
        for (int a = r < N ? 0 : r; a < (r < N ? NZ : r + 1); ++a)
            for (int c = 0; c <= a; ++c) H[a * NZ + c] += S[r][a] * T[c];
    }
}

/* The derivatives of one step from x: F[N NZ] = dx+/dz, l[NZ] = dcost/dz, H[NZ NZ], the lower triangle of the Hessian of
   lam'x+ + cost; returns the cost. */
static lane derivatives(const double *weights, const lane *x, const lane *u, DATA_IN const lane *lam, lane h,
                        lane *F, lane *l, lane *H BY_P_IN)
{
    lane Z[NS], X[STAGES][N], k[N + 1], net[STAGES][NET + 1], tape[STAGES][TAPE + 1], v[NV + 1], bend[BEND + 1];
    lane J[STAGES * NJ + 1], W[NW + 1], mu[STAGES * (N + 1)], A[NS][NS], S[STAGES][NZ][NZ], cost = {0};
    mask swaps[NS][NS];
    const mask done = stages(weights, x, u, DATA h, Z);
    for (int j = 0; j < STAGES; ++j) {
        stage_state(x, Z, j, X[j]);
        LATER(d, reach[j] * h, now)
        network_slopes(weights, X[j], u, NOW net[j], tape[j]);
        field(X[j], u, NOW net[j], k);
        cost += weight[STAGES - 1][j] * h * k[N];
        stage_jacobian(X[j], u, NOW net[j], J + j * NJ);
    }
    newton_matrix(J, h, A);
    factors(A, swaps);
    stage_slopes(J, h, A, swaps, S);
    stage_weights(J, lam, h, A, swaps, mu);
    for (int i = 0; i < N * NZ; ++i) F[i] = S[STAGES - 1][i / NZ][i % NZ];
    for (int i = 0; i < NZ; ++i) l[i] = (lane){0};
    for (int i = 0; i < NZ * NZ; ++i) H[i] = (lane){0};
    for (int j = 0; j < STAGES; ++j) {
        LATER(d, reach[j] * h, now)
        network_weights(X[j], u, NOW net[j], mu + j * (N + 1), v);
        network_bend(weights, v, tape[j], bend);
        stage_hessian(X[j], u, NOW net[j], bend, mu + j * (N + 1), W);
        congruence(W, S[j], H);
        for (int p = J_ROW[N]; p < J_ROW[N + 1]; ++p)
            for (int c = 0; c < NZ; ++c) l[c] += weight[STAGES - 1][j] * h * J[j * NJ + p] * S[j][J_COL[p]][c];
#if defined(ND) && NP > 0
        if (by_p) {
            lane part[NP];
            stage_parameters(X[j], u, now, net[j], bend, mu + j * (N + 1), part);
            for (int i = 0; i < NP; ++i) by_p[i] += part[i];
        }
#endif
    }
    return where(done, cost, splat(NAN));
}
