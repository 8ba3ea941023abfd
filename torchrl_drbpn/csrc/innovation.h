/* The innovation form: the gain by inv(S), S = M (H P H' + R) M', obs x obs.
 *
 * P is Q at an ordinary step and initial_cov at the first of an episode, so P H' (`cross`) and
 * H P H' + R (`cov`) are there twice; the mask M makes an S of its own of every row. Forward the
 * mean moves by P H' z with z = inv(S) e; back, e receives inv(S) H P g of what the mean receives,
 * g. filter.h calls these in the order in which they stand here, and those of
 * information.h at the same places.
 */

/* Invert M (H P H' + R) M' of LANES rows; the inverse is zero where nothing was observed. */
static void invert(const Sizes *s, const Ahead *a, long group, const uint8_t *observed,
                   const uint8_t *reset, real *inverse, real *log_det) {
    long n = s->obs;
    vec mask[n], again = {0}, *A = (vec *)a->factor, *I = (vec *)inverse;
    for (long l = 0; l < LANES; l++) {
        long r = group * LANES + l < s->rows ? group * LANES + l : s->rows - 1;
        long from = (r % s->batch) * s->time + r / s->batch;
        again[l] = reset[from];
        for (long i = 0; i < n; i++) mask[i][l] = observed[from * n + i];
    }
    for (long i = 0; i < n; i++)
        for (long j = 0; j <= i; j++) {
            /* Weights of exactly 0 or 1 choose exactly. */
            vec c = (1 - again) * a->cov[0][i * s->N + j] + again * a->cov[1][i * s->N + j];
            c *= mask[i] * mask[j];
            if (i == j) c += 1 - mask[i];
            A[i * n + j] = c;
        }
    invert_lanes(n, A, (vec *)a->lower, I, (vec *)log_det);
    for (long i = 0; i < n; i++)
        for (long j = 0; j < n; j++) I[i * n + j] *= mask[i] * mask[j];
}

/* Ahead of the loop: P H', H P H' + R and the inverses of all rows. */
static void prepare_innovation(const Sizes *s, const Ahead *a, const Tape *tape, void *const *cov,
                               const given *noise, const uint8_t *observed, const uint8_t *reset) {
    long n = s->obs, m = s->state, N = s->N, S = s->S;
    for (int k = 0; k < 2; k++) {
        take_in(m, m, cov[k], m, 1, a->prior[k], S);
        product(m, N, m, a->prior[k], S, 1, a->sensor_t, N, tape->cross[k], N, 1, 0);
        pack(n, m, tape->cross[k], 1, N, tape->cross_t[k], S);
        if (s->full_noise) take_in(n, n, noise, n, 1, a->cov[k], N);
        else {
            memset(a->cov[k], 0, n * N * sizeof(real));
            for (long i = 0; i < n; i++) a->cov[k][i * N + i] = noise[i];
        }
        product(n, N, m, a->sensor_t, 1, N, tape->cross[k], N, a->cov[k], N, 1, 1);
    }
    for (long g = 0; g < s->groups; g++)
        invert(s, a, g, observed, reset, tape->inverse + g * n * n * LANES, a->log_det + g * LANES);
}

/* One step from the predicted mean and the innovation e of each row, both in `a`: z = inv(S) e, the
 * mean moves by P H' z, of the P that the row started from. */
static void gain_innovation(const Sizes *s, const Ahead *a, const Tape *tape, long t,
                            const uint8_t *observed, const uint8_t *reset, given *mean, real *ll) {
    long n = s->obs, m = s->state, N = s->N, S = s->S, batch = s->batch, row = t * batch;
    real *z = tape->z + row * N;
    solve(0, n, N, row, row + batch, tape->inverse, a->error, a->error_lanes, tape->z);
    for (long b = 0; b < batch; b++)
        for (long i = n; i < N; i++) z[b * N + i] = 0;
    product_of_two(batch, reset + t, s->time, S, n, z, N, tape->cross_t, a->mean, S, 1);
    for (long b = 0; b < batch; b++) {
        long at = b * s->time + t, count = 0;
        real quadratic = 0;
        for (long i = 0; i < n; i++) {
            quadratic += z[b * N + i] * a->error[b * N + i];
            count += observed[at * n + i];
        }
        ll[at] = count ? -0.5 * (quadratic + a->log_det[row + b] + count * LOG_2PI) : 0;
        narrow(m, a->mean + b * S, mean + at * m);
    }
}

/* Ahead of the reverse loop: nothing is summed yet. */
static void begin_innovation(const Sizes *s, const Back *w) {
    for (int k = 0; k < 2; k++) {
        memset(w->cross[k], 0, s->state * s->N * sizeof(real));
        memset(w->cov[k], 0, s->obs * s->N * sizeof(real));
    }
}

/* By the innovation through the gain, one step: inv(S) (P H')' g. */
static void by_gain_innovation(const Sizes *s, const Back *w, const Tape *tape, long t,
                               const uint8_t *reset) {
    long n = s->obs, m = s->state, N = s->N, S = s->S, batch = s->batch, row = t * batch;
    real *u = w->left + row * N;
    product_of_two(batch, reset + t, s->time, N, m, w->filtered + row * S, S, tape->cross, u, N, 0);
    solve(0, n, N, row, row + batch, tape->inverse, u, w->lanes, w->error);
}

/* By S and P H', one row: at the start of an episode at once, else summed after the loop. */
static void by_innovation(const Sizes *s, const Back *w, const Tape *tape, long r, real half,
                          int again) {
    long n = s->obs, m = s->state, N = s->N;
    const real *z = tape->z + r * N;
    real *left = w->left + r * N;
    if (!again) {
        w->half[r] = half;
        return;
    }
    const real *inverse = tape->inverse + r / LANES * n * n * LANES;
    add_outer(n, n, left, z, w->cov[1], N);
    for (long i = 0; i < n * n; i++)
        w->cov[1][i / n * N + i % n] -= half * inverse[i * LANES + r % LANES];
    add_outer(m, n, w->filtered + r * s->S, z, w->cross[1], N);
    memset(left, 0, N * sizeof(real));
}

/* By R, H and P, once every row is there: S = H C + R with C = P H'; g_H holds its first part. */
static void finish_innovation(const Sizes *s, const Back *w, const Tape *tape, const given *H,
                              void *const *cov, void *const *g_cov) {
    real *g_noise = w->g_noise, *g_H = w->g_H;
    long n = s->obs, m = s->state, N = s->N, S = s->S;
    product(m, N, s->rows, w->filtered, 1, S, tape->z, N, w->cross[0], N, 1, 0);
    product(n, N, s->rows, w->left, 1, N, tape->z, N, w->cov[0], N, 1, 0);
    const vec *sum = (const vec *)w->sum;
    for (long i = 0; i < n; i++)
        for (long j = 0; j < n; j++) w->cov[0][i * N + j] -= over_lanes(sum[i * n + j]);

    memset(g_noise, 0, (s->full_noise ? n * n : n) * sizeof(real));
    take_in(n, m, H, m, 1, w->sensor, S); /* J is at least S */
    for (int k = 0; k < 2; k++) {
        for (long i = 0; i < n; i++)
            for (long j = 0; j < N; j++)
                w->square[i * N + j] =
                    j < n ? 0.5 * (w->cov[k][i * N + j] + w->cov[k][j * N + i]) : 0;
        for (long i = 0; i < n; i++) {
            if (!s->full_noise) g_noise[i] += w->square[i * N + i];
            else for (long j = 0; j < n; j++) g_noise[i * n + j] += w->square[i * N + j];
        }
        product(m, N, n, w->sensor, 1, S, w->square, N, w->cross[k], N, 1, 1);
        product(m, S, n, w->cross[k], N, 1, w->sensor, S, w->wide, S, 1, 0);
        give_out(m, m, w->wide, S, g_cov[k]);
        take_in(m, m, cov[k], m, 1, w->noise_prior[k], S);
        product(n, S, n, w->square, N, 1, tape->cross_t[k], S, w->wide, S, 1, 0);
        product(n, S, m, w->cross[k], 1, N, w->noise_prior[k], S, w->wide, S, 1, 1);
        for (long i = 0; i < n; i++)
            for (long j = 0; j < m; j++) g_H[i * m + j] += w->wide[i * S + j];
    }
}
