/* The chain rule through one explicit step, looped over sparse rows: for systems where straight-line code would be too much
   to compile. Generated before this file: N, NZ, NJ, NW and tables of the patterns, row by row (row r: X_ROW[r] to X_ROW[r+1],
   columns X_COL): J_ of d(xdot, L)/d(x, u), N + 1 rows; W_ of a stage's Hessian, whole, with W_AT the place among its NW
   nonzeros; S_ of d(a stage's state, u)/d(x, u), closed under multiplication by J, with the diagonal; T_ of W S. */

/* mu[j (N+1)], what weights stage j: lam and 1 by its share in the step, and what later stages make of it. */
static void stage_adjoints(const lane *J, const lane *lam, const lane *h, lane *mu)
{
    for (int j = PARTS - 1; j >= 0; --j) {
        lane *now = mu + j * (N + 1);
        for (int i = 0; i <= N; ++i) now[i] = share[j] * *h * (i < N ? lam[i] : splat(1));
        if (j < PARTS - 1)
            for (int r = 0; r <= N; ++r) {
                const lane later = reach[j + 1] * *h * now[N + 1 + r];
                for (int p = J_ROW[r]; p < J_ROW[r + 1]; ++p)
                    if (J_COL[p] < N) now[J_COL[p]] += J[(j + 1) * NJ + p] * later;
            }
    }
}

/* H += S' W S, lower triangle. */
static void congruence(const lane *W, const lane *S, lane *H)
{
    for (int r = 0; r < NZ; ++r) {
        lane T[NZ];
        for (int q = T_ROW[r]; q < T_ROW[r + 1]; ++q) T[T_COL[q]] = (lane){0};
        for (int p = W_ROW[r]; p < W_ROW[r + 1]; ++p) {
            const lane w = W[W_AT[p]];
            for (int q = S_ROW[W_COL[p]]; q < S_ROW[W_COL[p] + 1]; ++q) T[S_COL[q]] += w * S[q];
        }
        for (int a = S_ROW[r]; a < S_ROW[r + 1]; ++a) {
            lane *row = H + S_COL[a] * NZ;
            for (int q = T_ROW[r]; q < T_ROW[r + 1] && T_COL[q] <= S_COL[a]; ++q) row[T_COL[q]] += S[a] * T[T_COL[q]];
        }
    }
}

/* F[N NZ] = dx+/dz, l[NZ] = dcost/dz, lower triangle of H[NZ NZ] = Hessian of lam'x+ + cost; lam is in W. */
static void step_derivatives(const lane *J, const lane *W, const lane *h, lane *F, lane *l, lane *H)
{
    lane S[S_ROW_END], next[S_ROW_END];
    for (int i = 0; i < N * NZ; ++i) F[i] = splat(i / NZ == i % NZ);
    for (int i = 0; i < NZ * NZ; ++i) H[i] = (lane){0};
    for (int i = 0; i < NZ; ++i) {
        l[i] = (lane){0};
        for (int q = S_ROW[i]; q < S_ROW[i + 1]; ++q) S[q] = next[q] = splat(S_COL[q] == i);
    }
    for (int j = 0; j < PARTS; ++j, J += NJ, W += NW) {
        congruence(W, S, H);
        for (int r = 0; r <= N; ++r) {
            lane row[NZ];
            for (int i = 0; i < NZ; ++i) row[i] = (lane){0};
            for (int p = J_ROW[r]; p < J_ROW[r + 1]; ++p)
                for (int q = S_ROW[J_COL[p]]; q < S_ROW[J_COL[p] + 1]; ++q) row[S_COL[q]] += J[p] * S[q];
            if (r == N)
                for (int i = 0; i < NZ; ++i) l[i] += share[j] * *h * row[i];
            else
                for (int q = S_ROW[r]; q < S_ROW[r + 1]; ++q) {
                    const int c = S_COL[q];
                    F[r * NZ + c] += share[j] * *h * row[c];
                    if (j < PARTS - 1) next[q] = splat(c == r) + reach[j + 1] * *h * row[c];
                }
        }
        for (int q = 0; q < S_ROW_END; ++q) S[q] = next[q];
    }
}
