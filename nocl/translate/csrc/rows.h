/* The augmented Lagrangian of a problem's constraints, for ddp.h. Generated before this file: NC and NT, the number of rows at a
   stage and at the end; whether each is an equality, EQUAL[], END_EQUAL[], whether a stage's holds no control, OF_X[], and whether
   one at the end is its own, no stage's, END_OWN[]; and

   stage_rows(x, u, c), end_rows(x, c)                      c >= 0, or c = 0
   stage_rows_model(x, u, a, w, bent, g, W)                 g = -C'a, W = C'diag(w) C - Hessian of bent'c, in z = (x, u)
   end_rows_model(x, a, w, bent, g, W)                      the same in x
   stage_rows_parameters(x, u, d, a, g), end_rows_parameters(x, d, a, g)    g = -(dc/dp)'a, with parameters

   A problem's rows stand in [ROWS]: those of stage k from k NC on, those of the end behind all stages. Each has a multiplier y and
   a margin (c is less by it; the array may be NULL), and each problem five numbers, penalty [B, 5]: rho, the largest multiplier
   (infinite where constraints are hard), in a sweep for gains the weight of active rows (else 0), the largest multiplier of
   the end's own rows, and 0 where a sweep leaves out second derivatives of f and of the rows (else 1).

   With q = y - rho c the multiplier after this step is a, q cut to [0, largest], or to [-largest, largest] of an equality; what is
   added to the cost is psi, whose slope in c is -a; and e = (y - a) / rho is 0 where c and y fit. */
#define ROWS (K * NC + NT)

typedef struct { lane rho, largest, stiff, at_end, bend, psi, square, worst; } lagrangian;

static lagrangian lagrangian_of(const double *penalty_, const int64_t *at)
{
    lagrangian of = {gather(penalty_, at, 5, 0), gather(penalty_, at, 5, 1), gather(penalty_, at, 5, 2), gather(penalty_, at, 5, 3),
                     gather(penalty_, at, 5, 4)};
    return of;
}

/* The largest multiplier of row i of a stage, or of the end. */
static inline lane largest_of(const lagrangian *of, int end, int i) { return end && END_OWN[i] ? of->at_end : of->largest; }

/* The multiplier a of a row, and its weight in the Hessian: rho where it is free, a little where it is the largest. */
static lane multiplier(const lagrangian *of, lane c, lane y, int equal, lane most, lane *weight)
{
    const lane q = y - of->rho * c, least = equal ? -most : (lane){0};
    const lane a = where(q < least, least, where(q > most, most, q));
    const mask low = q <= least, free = (q > least) & (q < most), capped = (q >= most) | (equal ? low : (mask){0});
    const mask active = free & (equal ? all_lanes() : a > 1e-16 * of->stiff);
    const lane held = where(of->stiff > 0, where(active, of->stiff, (lane){0}), where(free, of->rho, (lane){0}));
    *weight = where(capped, 1e-3 * of->rho, held);
    return a;
}

/* Adds a row to psi, sum rho e^2 / 2 and max |e|. */
static void add_row(lagrangian *of, lane c, lane y, int equal, lane most)
{
    const lane q = y - of->rho * c, least = equal ? -most : (lane){0};
    const lane a = where(q < least, least, where(q > most, most, q)), share = 1 / of->rho;
    const mask within = q == a;
    const lane e = where(within, c, (y - a) * share), size = where(e < 0, -e, e);
    of->psi += where(within, (0.5 * of->rho * c - y) * c, (0.5 * (a * a - y * y) + (q - a) * a) * share);
    of->square += 0.5 * of->rho * e * e;
    of->worst = where(size > of->worst, size, of->worst);
}

/* What a row is held by at node t: nothing where x alone is given there. */
static inline int is_row(int64_t t, int i) { return t > 0 || !OF_X[i]; }

static inline lane with_margin(const double *margin_, const int64_t *at, int64_t rows, int64_t row, lane c)
{
    return margin_ ? c - gather(margin_, at, rows, row) : c;
}

/* Adds the rows of stage t, or for t = K of the end, c as it is without margins. */
static void add_rows(lagrangian *of, const lane *c, const double *y_, const double *margin_, const int64_t *at, int64_t K, int64_t t)
{
    const int end = t == K, n = end ? NT : NC;
    for (int i = 0; i < n; ++i)
        if (end || is_row(t, i)) {
            const int64_t row = t * NC + i;
            add_row(of, with_margin(margin_, at, ROWS, row, c[i]), gather(y_, at, ROWS, row), (end ? END_EQUAL : EQUAL)[i],
                    largest_of(of, end, i));
        }
}

static void scatter_rows(double *c_, const lane *c, int n, const int64_t *at, int64_t rows, int64_t first)
{
    for (int i = 0; i < n; ++i) scatter(c_, at, rows, first + i, c[i]);
}

/* a, w and bent of n rows from their values; bend is 0 where second derivatives are left out. */
static void weigh_rows(const lagrangian *of, const lane *c, lane bend, const double *y_, const double *margin_, const int64_t *at,
                       int64_t K, int64_t t, lane *a, lane *w, lane *bent)
{
    const int end = t == K, n = end ? NT : NC;
    for (int i = 0; i < n; ++i) {
        const int64_t row = t * NC + i;
        a[i] = w[i] = (lane){0};
        if (end || is_row(t, i))
            a[i] = multiplier(of, with_margin(margin_, at, ROWS, row, c[i]), gather(y_, at, ROWS, row),
                              (end ? END_EQUAL : EQUAL)[i], largest_of(of, end, i), w + i);
        bent[i] = bend * a[i];
    }
}

/* y becomes a under the rho of penalty_, which then grows by a factor; the merit and its parts are those of the new ones. */
void nocl_multipliers(int64_t first, int64_t last, const int64_t *index, int64_t K, const double *margin_, const double *c_,
                      const double *factor_, double *y_, double *penalty_, double *merit_, double *parts_)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        const lagrangian before = lagrangian_of(penalty_, at);
        lagrangian after = before;
        const lane cost = gather(parts_, at, 3, 0);
        after.rho *= gather(factor_, at, 1, 0);
        for (int64_t t = 0; t <= K; ++t)
            for (int i = 0; i < (t == K ? NT : NC); ++i) {
                const int64_t row = t * NC + i;
                const int equal = (t == K ? END_EQUAL : EQUAL)[i];
                if (t < K && !is_row(t, i)) continue;
                lane weight;
                const lane c = with_margin(margin_, at, ROWS, row, gather(c_, at, ROWS, row));
                const lane most = largest_of(&before, t == K, i), a = multiplier(&before, c, gather(y_, at, ROWS, row), equal, most, &weight);
                scatter(y_, at, ROWS, row, a);
                add_row(&after, c, a, equal, most);
            }
        scatter(penalty_, at, 5, 0, after.rho);
        scatter(merit_, at, 1, 0, cost + after.psi);
        scatter(parts_, at, 3, 1, after.square);
        scatter(parts_, at, 3, 2, after.worst);
    }
}
