/* Control-limited DDP over lanes. Generated before this file: N, M, the lengths NET (networks' values and slopes), TAPE (what
   their adjoint pass needs), NV (their values), BEND (their Hessians and adjoints), all 0 without networks, NJ, NW (nonzeros
   of a stage's Jacobian and Hessian), and

   network_values(weights, x, u, net)         the values' places in net[NET]
   network_slopes(weights, x, u, net, tape)   all of net[NET]
   network_weights(x, u, net, mu, v)          v[NV] = d(mu'(xdot, L))/d(values)
   network_bend(weights, v, tape, bend)       bend[BEND]
   field(x, u, net, out)                      out[N+1]: xdot, L; reads only the networks' values
   stage_jacobian(x, u, net, J)               nonzeros of d(xdot, L)/d(x, u), row by row
   stage_hessian(x, u, net, bend, mu, W)      nonzeros of the Hessian of mu'(xdot, L)
   stage_adjoints(J, lam, h, mu)              mu[PARTS (N+1)], what weights the PARTS stages of an explicit step
   step_derivatives(J, W, h, F, l, H)         F[N NZ] = dx+/dz, l[NZ] = dcost/dz, H[NZ NZ] the Hessian of lam'x+ + cost
                                              (only its lower triangle is read); these two may stand in chain.h
   terminal(x, G, Gx, Gxx)

   and SUBSTEPS, the steps in each interval, whose control is held over all of them. Implicit steps have what radau.h lists in
   place of stage_adjoints() and step_derivatives().

   A problem that holds the time or parameters has ND, TIMED (whether it holds the time) and NP too: its data d[ND] are t, where
   TIMED, then the NP parameters, and every function above that takes x takes d as well, behind x and u; with NP > 0 also

   stage_parameters(x, u, d, net, bend, mu, out)    out[NP] = d(mu'(xdot, L))/dp
   terminal_parameters(x, d, out)                   out[NP] = dG/dp

   The kernels take d_ [B, ND] behind h_, t at the start of each problem, and nocl_backward one more result, V_p [B, NP].

   A problem with constraints has what rows.h lists. Its kernels take y [B, ROWS], margin [B, ROWS] or NULL and penalty [B, 5] behind
   all else, nocl_rollout also c [B, ROWS] and parts [B, 3] = (cost, sum rho e^2 / 2, max |e|), and its J is the merit, cost + psi. Its
   sweeps leave out the second derivatives of f and of the rows (Gauss-Newton) where the last of these five is 0.

   Arrays are problem-major, rows as numpy has them: x [B, K+1, N], u [B, K, M], gains [B, K, M, N]. */
#ifdef ND
#define DATA_IN const lane *d,
#define DATA d,
#define BEGIN begin,
#define NOW now,
#define DATA_ARRAY const double *d_,
#define GATHER_DATA lane begin[ND]; for (int i = 0; i < ND; ++i) begin[i] = gather(d_, at, ND, i);
#define LATER(from, time, to) lane to[ND]; later(from, time, to);
#define BY_P_ARRAY , double *by_p_
#define BY_P_IN , lane *by_p
#define BY_P , by_p

/* The data of a problem a time later. */
static void later(const lane *d, lane time, lane *now)
{
    for (int i = 0; i < ND; ++i) now[i] = TIMED && i == 0 ? d[i] + time : d[i];
}
#else
#define DATA_IN
#define DATA
#define BEGIN
#define NOW
#define DATA_ARRAY
#define GATHER_DATA
#define LATER(from, time, to)
#define BY_P_ARRAY
#define BY_P_IN
#define BY_P
#endif

#ifdef NC
#include "rows.h"
#define ROWS_IN , const double *y_, const double *margin_, const double *penalty_
#define ROWS_OUT , double *c_, double *parts_
#define BENT_IN , lane bent
#define BENT , bent
#define ALONG(from, lam) lane lam[N]; for (int i = 0; i < N; ++i) lam[i] = bent * from[i];
#else
#define ROWS_IN
#define ROWS_OUT
#define BENT_IN
#define BENT
#define ALONG(from, lam) const lane *lam = from;
#endif

#ifdef STAGES
#include "radau.h"
#else
/* One explicit step, x to next; returns its cost. */
static lane step(const double *weights, const lane *x, const lane *u, DATA_IN lane h, lane *next)
{
    lane s[N], k[N + 1], net[NET + 1], cost = {0};
    for (int i = 0; i < N; ++i) next[i] = x[i];
    for (int j = 0; j < PARTS; ++j) {
        for (int i = 0; i < N; ++i) s[i] = j ? x[i] + reach[j] * h * k[i] : x[i];
        LATER(d, reach[j] * h, now)
        network_values(weights, s, u, NOW net);
        field(s, u, NOW net, k);
        for (int i = 0; i < N; ++i) next[i] += share[j] * h * k[i];
        cost += share[j] * h * k[N];
    }
    return cost;
}

/* The derivatives of one explicit step from x, second ones along lam (see step_derivatives); returns its cost. */
static lane derivatives(const double *weights, const lane *x, const lane *u, DATA_IN const lane *lam, lane h,
                        lane *F, lane *l, lane *H BY_P_IN)
{
    lane s[PARTS][N], k[N + 1], net[PARTS][NET + 1], tape[PARTS][TAPE + 1], v[NV + 1], bend[BEND + 1];
    lane J[PARTS * NJ + 1], W[PARTS * NW + 1], mu[PARTS * (N + 1)], cost = {0};
    for (int j = 0; j < PARTS; ++j) {
        for (int i = 0; i < N; ++i) s[j][i] = j ? x[i] + reach[j] * h * k[i] : x[i];
        LATER(d, reach[j] * h, now)
        network_slopes(weights, s[j], u, NOW net[j], tape[j]);
        field(s[j], u, NOW net[j], k);
        cost += share[j] * h * k[N];
        stage_jacobian(s[j], u, NOW net[j], J + j * NJ);
    }
    stage_adjoints(J, lam, &h, mu);
    for (int j = 0; j < PARTS; ++j) {
        LATER(d, reach[j] * h, now)
        network_weights(s[j], u, NOW net[j], mu + j * (N + 1), v);
        network_bend(weights, v, tape[j], bend);
        stage_hessian(s[j], u, NOW net[j], bend, mu + j * (N + 1), W + j * NW);
#if defined(ND) && NP > 0
        if (by_p) {
            lane part[NP];
            stage_parameters(s[j], u, now, net[j], bend, mu + j * (N + 1), part);
            for (int i = 0; i < NP; ++i) by_p[i] += part[i];
        }
#endif
    }
    step_derivatives(J, W, &h, F, l, H);
    return cost;
}
#endif

/* u = clip(u_bar + alpha k + gain (x - x_bar)) from x0; writes x, u, J. */
void nocl_rollout(int64_t first, int64_t last, const int64_t *index, int64_t K, const double *weights,
                  const double *lb, const double *ub, const double *h_, DATA_ARRAY const double *x0, const double *x_bar,
                  const double *u_bar, const double *k, const double *gain, const double *alpha,
                  double *x_, double *u_, double *J ROWS_IN ROWS_OUT)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane x[N], u[M], next[N], G[1], Gx[N], Gxx[N * N], cost = {0};
        const lane h = gather(h_, at, 1, 0), a = gather(alpha, at, 1, 0);
        GATHER_DATA
#ifdef NC
        lagrangian rows = lagrangian_of(penalty_, at);
#endif
        for (int i = 0; i < N; ++i) x[i] = gather(x0, at, N, i);
        for (int64_t t = 0; t < K; ++t) {
            lane dx[N];
            for (int i = 0; i < N; ++i) {
                scatter(x_, at, (K + 1) * N, t * N + i, x[i]);
                dx[i] = x[i] - gather(x_bar, at, (K + 1) * N, t * N + i);
            }
            for (int j = 0; j < M; ++j) {
                u[j] = gather(u_bar, at, K * M, t * M + j) + a * gather(k, at, K * M, t * M + j);
                for (int i = 0; i < N; ++i) u[j] += gather(gain, at, K * M * N, (t * M + j) * N + i) * dx[i];
                u[j] = where(u[j] < splat(lb[j]), splat(lb[j]), where(u[j] > splat(ub[j]), splat(ub[j]), u[j]));
                scatter(u_, at, K * M, t * M + j, u[j]);
            }
#ifdef NC
            {
                lane c[NC + 1];
                LATER(begin, (double)t * h, now)
                stage_rows(x, u, NOW c);
                scatter_rows(c_, c, NC, at, ROWS, t * NC);
                add_rows(&rows, c, y_, margin_, at, K, t);
            }
#endif
            for (int part = 0; part < SUBSTEPS; ++part) {
                LATER(begin, (t + part / (double)SUBSTEPS) * h, now)
                cost += step(weights, x, u, NOW h / SUBSTEPS, next);
                for (int i = 0; i < N; ++i) x[i] = next[i];
            }
        }
        for (int i = 0; i < N; ++i) scatter(x_, at, (K + 1) * N, K * N + i, x[i]);
        terminal(x, BEGIN G, Gx, Gxx);
#ifdef NC
        lane c[NT + 1];
        end_rows(x, BEGIN c);
        scatter_rows(c_, c, NT, at, ROWS, K * NC);
        add_rows(&rows, c, y_, margin_, at, K, K);
        scatter(parts_, at, 3, 0, cost + G[0]);
        scatter(parts_, at, 3, 1, rows.square);
        scatter(parts_, at, 3, 2, rows.worst);
        cost += rows.psi;
#endif
        scatter(J, at, 1, 0, cost + G[0]);
    }
}

/* L L' = Q on the free controls, the identity on those held; returns where Q is positive definite. */
static mask factor(lane Q[M][M], const mask *held, lane L[M][M])
{
    mask positive = all_lanes();
    for (int i = 0; i < M; ++i)
        for (int j = 0; j <= i; ++j) {
            lane sum = where(held[i] | held[j], splat(i == j), Q[i][j]);
            for (int r = 0; r < j; ++r) sum -= L[i][r] * L[j][r];
            if (i == j) {
                const mask ok = held[i] | (sum > 1e-12 * Q[i][i]);  /* sum <= Q_ii: false where that is <= 0 */
                positive &= ok;
                L[i][i] = v_sqrt(where(ok, sum, splat(1)));
            } else
                L[i][j] = sum / L[j][j];
        }
    return positive;
}

/* L L' x = x, in place. */
static void substitute(lane L[M][M], lane *x)
{
    for (int i = 0; i < M; ++i) {
        for (int r = 0; r < i; ++r) x[i] -= L[i][r] * x[r];
        x[i] /= L[i][i];
    }
    for (int i = M - 1; i >= 0; --i) {
        for (int r = i + 1; r < M; ++r) x[i] -= L[r][i] * x[r];
        x[i] /= L[i][i];
    }
}

/* Moves k towards k + p as far as the first bound, in busy lanes; returns where one blocked, and marks those controls. */
static mask step_to_bound(const lane *p, const lane *low, const lane *high, mask busy, lane *k, mask *blocked)
{
    lane reach[M], shortest = splat(1);
    mask any = {0};
    for (int i = 0; i < M; ++i) {
        const lane room = where(p[i] > 0, high[i], low[i]) - k[i];
        reach[i] = where(p[i] != 0, room / p[i], splat(INFINITY));
        shortest = where(reach[i] < shortest, reach[i], shortest);
    }
    shortest = where(shortest < 0, (lane){0}, shortest);
    for (int i = 0; i < M; ++i) {
        blocked[i] = busy & (reach[i] <= shortest) & (reach[i] < 1);
        any |= blocked[i];
        const lane next = where(blocked[i], where(p[i] > 0, high[i], low[i]), k[i] + shortest * p[i]);
        k[i] = where(busy, next, k[i]);
    }
    return any;
}

/* Lets go, in the lanes that may, the held control whose multiplier has the wrong sign by most; returns where one did. */
static mask release(lane Q[M][M], const lane *q, const lane *k, const lane *low, mask may, mask *held)
{
    lane wrong[M], most = {0};
    mask any = {0};
    for (int i = 0; i < M; ++i) {
        lane g = q[i];
        for (int j = 0; j < M; ++j) g += Q[i][j] * k[j];
        wrong[i] = where(held[i] & may, where(k[i] <= low[i], -g, g), (lane){0});
        most = where(wrong[i] > most, wrong[i], most);
    }
    for (int i = 0; i < M; ++i) {
        const mask let_go = (wrong[i] > 0) & (wrong[i] == most);
        held[i] &= ~let_go;
        any |= let_go;
    }
    return any;
}

/* min q'k + k'Q k / 2 with u + k in [lb, ub], by a primal active-set method from k = 0: the model never rises, so that k
   is a direction of descent even where the passes end early. L is the factor of Q on the controls that end up free. */
static mask boxed_newton(lane Q[M][M], const lane *q, const lane *u, const double *lb, const double *ub,
                         mask *held, lane *k, lane L[M][M])
{
    const int passes = 3 * M;
    mask positive = all_lanes(), busy = all_lanes();
    lane low[M], high[M];
    for (int i = 0; i < M; ++i) {
        low[i] = splat(lb[i]) - u[i];
        high[i] = splat(ub[i]) - u[i];
        held[i] = ((low[i] >= 0) & (q[i] > 0)) | ((high[i] <= 0) & (q[i] < 0));
        k[i] = (lane){0};
    }
    for (int pass = 0;; ++pass) {
        lane p[M];
        mask blocked[M];
        for (int i = 0; i < M; ++i) {
            p[i] = -q[i];
            for (int j = 0; j < M; ++j) p[i] -= Q[i][j] * k[j];
            p[i] = where(held[i], (lane){0}, p[i]);
        }
        positive &= factor(Q, held, L) | ~busy;
        substitute(L, p);
        const mask stopped = step_to_bound(p, low, high, busy, k, blocked);
        if (pass == passes) return positive;
        for (int i = 0; i < M; ++i) held[i] |= blocked[i];
        busy &= stopped | release(Q, q, k, low, busy & ~stopped, held);
        if (!any_lane(busy)) return positive;
    }
}

/* gain = -Q^-1 Qux on the free controls, 0 on those held. */
static void feedback(lane L[M][M], lane Q[NZ][NZ], const mask *held, lane gain[M][N])
{
    for (int i = 0; i < N; ++i) {
        lane column[M];
        for (int j = 0; j < M; ++j) column[j] = where(held[j], (lane){0}, -Q[N + j][i]);
        substitute(L, column);
        for (int j = 0; j < M; ++j) gain[j][i] = column[j];
    }
}

/* Q = H + F' Vxx F, q = l + F' Vx. */
static void action_value(const lane *F, const lane *l, const lane *H, const lane *Vx, const lane *Vxx,
                         lane Q[NZ][NZ], lane *q)
{
    lane VF[N][NZ];
    for (int i = 0; i < N; ++i)
        for (int j = 0; j < NZ; ++j) {
            lane sum = {0};
            for (int r = 0; r < N; ++r) sum += Vxx[i * N + r] * F[r * NZ + j];
            VF[i][j] = sum;
        }
    for (int i = 0; i < NZ; ++i) {
        q[i] = l[i];
        for (int r = 0; r < N; ++r) q[i] += F[r * NZ + i] * Vx[r];
        for (int j = 0; j <= i; ++j) {
            lane sum = H[i * NZ + j];
            for (int r = 0; r < N; ++r) sum += F[r * NZ + i] * VF[r][j];
            Q[i][j] = Q[j][i] = sum;
        }
    }
}

/* Q and q in z = (x, u) before one more step with u held, from theirs after it. */
static void earlier(const lane *F, const lane *l, const lane *H, lane Q[NZ][NZ], lane *q)
{
    lane Vx[N], Vxx[N * N], old[NZ][NZ], qu[M];
    for (int i = 0; i < N; ++i) {
        Vx[i] = q[i];
        for (int j = 0; j < N; ++j) Vxx[i * N + j] = Q[i][j];
    }
    for (int i = 0; i < NZ; ++i)
        for (int j = 0; j < NZ; ++j) old[i][j] = Q[i][j];
    for (int j = 0; j < M; ++j) qu[j] = q[N + j];
    action_value(F, l, H, Vx, Vxx, Q, q);
    for (int a = 0; a < M; ++a) {
        q[N + a] += qu[a];
        for (int j = 0; j < NZ; ++j) {
            lane sum = j < N ? (lane){0} : old[N + a][j];
            for (int r = 0; r < N; ++r) sum += old[N + a][r] * F[r * NZ + j];
            Q[N + a][j] += sum;
            Q[j][N + a] = j < N ? Q[N + a][j] : Q[j][N + a];
        }
        for (int c = 0; c < M; ++c)
            for (int r = 0; r < N; ++r) Q[N + c][N + a] += old[N + a][r] * F[r * NZ + N + c];
    }
}

/* Q and q of an interval from V at its end; returns its cost. Adds to dV/dp where it is asked for. */
static lane interval(const double *weights, const lane *x, const lane *u, DATA_IN lane h, const lane *Vx, const lane *Vxx,
                     lane Q[NZ][NZ], lane *q BENT_IN BY_P_IN)
{
    lane s[SUBSTEPS][N], F[N * NZ], l[NZ], H[NZ * NZ], cost;
    for (int i = 0; i < N; ++i) s[0][i] = x[i];
    for (int part = 1; part < SUBSTEPS; ++part) {
        LATER(d, (part - 1) * h / SUBSTEPS, now)
        step(weights, s[part - 1], u, NOW h / SUBSTEPS, s[part]);
    }
    LATER(d, (SUBSTEPS - 1) * h / SUBSTEPS, now)
    ALONG(Vx, lam)
    cost = derivatives(weights, s[SUBSTEPS - 1], u, NOW lam, h / SUBSTEPS, F, l, H BY_P);
    action_value(F, l, H, Vx, Vxx, Q, q);
    for (int part = SUBSTEPS - 2; part >= 0; --part) {
        LATER(d, part * h / SUBSTEPS, now)
        ALONG(q, lam)
        cost += derivatives(weights, s[part], u, NOW lam, h / SUBSTEPS, F, l, H BY_P);
        earlier(F, l, H, Q, q);
    }
    return cost;
}

/* V of this node from the next one's, under u + k + gain dx. */
static void value_update(lane Q[NZ][NZ], const lane *q, const lane *k, lane gain[M][N], lane *Vx, lane *Vxx)
{
    lane QK[M][N], Qk[M];  /* Quu gain + Qux, Quu k + qu */
    for (int j = 0; j < M; ++j) {
        Qk[j] = q[N + j];
        for (int r = 0; r < M; ++r) Qk[j] += Q[N + j][N + r] * k[r];
        for (int i = 0; i < N; ++i) {
            QK[j][i] = Q[N + j][i];
            for (int r = 0; r < M; ++r) QK[j][i] += Q[N + j][N + r] * gain[r][i];
        }
    }
    for (int i = 0; i < N; ++i) {
        Vx[i] = q[i];
        for (int j = 0; j < M; ++j) Vx[i] += gain[j][i] * Qk[j] + Q[N + j][i] * k[j];
        for (int c = 0; c <= i; ++c) {
            lane sum = Q[i][c];
            for (int j = 0; j < M; ++j) sum += gain[j][i] * QK[j][c] + Q[N + j][i] * gain[j][c];
            Vxx[i * N + c] = Vxx[c * N + i] = sum;
        }
    }
}

#ifdef NC
/* Adds a stage's rows to Q and q, and to dV/dp where it is asked for. */
static void stage_held(const lagrangian *of, const lane *x, const lane *u, DATA_IN const double *y_, const double *margin_,
                       const int64_t *at, int64_t K, int64_t t, lane Q[NZ][NZ], lane *q BENT_IN BY_P_IN)
{
    lane c[NC + 1], a[NC + 1], w[NC + 1], second[NC + 1], g[NZ], W[NZ * NZ];
    stage_rows(x, u, DATA c);
    weigh_rows(of, c, bent, y_, margin_, at, K, t, a, w, second);
    stage_rows_model(x, u, DATA a, w, second, g, W);
    for (int i = 0; i < NZ; ++i) {
        q[i] += g[i];
        for (int j = 0; j < NZ; ++j) Q[i][j] += W[i * NZ + j];
    }
#if defined(ND) && NP > 0
    if (by_p) {
        lane part[NP];
        stage_rows_parameters(x, u, d, a, part);
        for (int i = 0; i < NP; ++i) by_p[i] += part[i];
    }
#endif
}

/* Adds the rows of the end to V_x and V_xx, and to dV/dp where it is asked for. */
static void end_held(const lagrangian *of, const lane *x, DATA_IN const double *y_, const double *margin_, const int64_t *at,
                     int64_t K, lane *Vx, lane *Vxx BENT_IN BY_P_IN)
{
    lane c[NT + 1], a[NT + 1], w[NT + 1], second[NT + 1], g[N], W[N * N];
    end_rows(x, DATA c);
    weigh_rows(of, c, bent, y_, margin_, at, K, K, a, w, second);
    end_rows_model(x, DATA a, w, second, g, W);
    for (int i = 0; i < N; ++i) Vx[i] += g[i];
    for (int i = 0; i < N * N; ++i) Vxx[i] += W[i];
#if defined(ND) && NP > 0
    if (by_p) {
        lane part[NP];
        end_rows_parameters(x, d, a, part);
        for (int i = 0; i < NP; ++i) by_p[i] += part[i];
    }
#endif
}
#endif

/* The Riccati sweep about (x, u). Writes k, gain, slope = sum k'q, curve = sum k'Q k / 2, whether every Quu + mu D was
   positive, and, where asked for (not NULL), V [B, K+1], V_x [B, K+1, N], V_xx [B, K+1, N, N]; with parameters V_p [B, NP],
   the gradient of the trajectory's cost, which is that of the optimum's. */
void nocl_backward(int64_t first, int64_t last, const int64_t *index, int64_t K, const double *weights,
                   const double *lb, const double *ub, const double *h_, DATA_ARRAY const double *x_, const double *u_,
                   const double *mu_, double *k_, double *gain_, double *slope_, double *curve_, double *positive_,
                   double *V_, double *Vx_, double *Vxx_ BY_P_ARRAY ROWS_IN)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane x[N], u[M], V[1], Vx[N], Vxx[N * N], slope = {0}, curve = {0};
        const lane h = gather(h_, at, 1, 0), reg = gather(mu_, at, 1, 0);
        GATHER_DATA
        mask positive = all_lanes();
        for (int i = 0; i < N; ++i) x[i] = gather(x_, at, (K + 1) * N, K * N + i);
        terminal(x, BEGIN V, Vx, Vxx);
#ifdef ND
        lane sums[NP + 1], *by_p = by_p_ ? sums : 0;
#if NP > 0
        if (by_p) terminal_parameters(x, begin, by_p);
#endif
#endif
#ifdef NC
        const lagrangian rows = lagrangian_of(penalty_, at);
        const lane bent = rows.bend;
        end_held(&rows, x, BEGIN y_, margin_, at, K, Vx, Vxx BENT BY_P);
#endif
        for (int64_t t = K;; --t) {
            if (V_) scatter(V_, at, K + 1, t, V[0]);
            if (Vx_) for (int i = 0; i < N; ++i) scatter(Vx_, at, (K + 1) * N, t * N + i, Vx[i]);
            if (Vxx_) for (int i = 0; i < N * N; ++i) scatter(Vxx_, at, (K + 1) * N * N, t * N * N + i, Vxx[i]);
            if (t == 0) break;
            lane Q[NZ][NZ], q[NZ], Quu[M][M], L[M][M], k[M], gain[M][N];
            mask held[M];
            for (int i = 0; i < N; ++i) x[i] = gather(x_, at, (K + 1) * N, (t - 1) * N + i);
            for (int j = 0; j < M; ++j) u[j] = gather(u_, at, K * M, (t - 1) * M + j);
            LATER(begin, (double)(t - 1) * h, now)
            V[0] += interval(weights, x, u, NOW h, Vx, Vxx, Q, q BENT BY_P);
#ifdef NC
            stage_held(&rows, x, u, NOW y_, margin_, at, K, t - 1, Q, q BENT BY_P);
#endif
            for (int i = 0; i < M; ++i)
                for (int j = 0; j < M; ++j) Quu[i][j] = Q[N + i][N + j] + (i == j ? reg * DAMPED[i] : (lane){0});
            positive &= boxed_newton(Quu, q + N, u, lb, ub, held, k, L);
            feedback(L, Q, held, gain);
            for (int j = 0; j < M; ++j) {
                slope += k[j] * q[N + j];
                for (int r = 0; r < M; ++r) curve += 0.5 * k[j] * Q[N + j][N + r] * k[r];
                scatter(k_, at, K * M, (t - 1) * M + j, k[j]);
                for (int i = 0; i < N; ++i) scatter(gain_, at, K * M * N, ((t - 1) * M + j) * N + i, gain[j][i]);
            }
            value_update(Q, q, k, gain, Vx, Vxx);
        }
#ifdef ND
        if (by_p) for (int i = 0; i < NP; ++i) scatter(by_p_, at, NP, i, by_p[i]);
#endif
        positive &= is_finite(slope) & is_finite(curve);
        scatter(slope_, at, 1, 0, slope);
        scatter(curve_, at, 1, 0, curve);
        scatter(positive_, at, 1, 0, truth(positive));
    }
}
