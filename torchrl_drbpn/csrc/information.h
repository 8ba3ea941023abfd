/* The information form: the gain by C = inv(inv(P) + H' W H), state x state, W = observed / R.
 *
 * The caller gives the inverses of Q and initial_cov in their places (`prior`); of C, symmetric,
 * the lower triangle is kept. Forward the mean moves by C H' W e; back, e receives W H C g of what
 * the mean receives, g. Likelihoods are without log|P|, which the caller knows.
 *
 * Where the covariance is propagated C is the next state of its recursion and P differs from row to
 * row: propagated.h runs it ahead, keeps inv(P) of each row beside C, and log|P| is in the
 * likelihood; Q and initial_cov themselves stand in `prior`.
 */

/* C = inv(inv(P) + sum_i w_i h_i h_i') of two groups of LANES rows, w_i = observed_i / r_i. */
static void gather(const Sizes *s, const Ahead *a, long group, const uint8_t *observed,
                   const uint8_t *reset, real *inverse, real *log_det) {
    long n = s->obs, m = s->state;
    vec again[2] = {{0}}, *A = (vec *)a->factor, *I = (vec *)a->square;
    for (long l = 0; l < 2 * LANES; l++) {
        long r = group * LANES + l < s->rows ? group * LANES + l : s->rows - 1;
        long from = (r % s->batch) * s->time + r / s->batch;
        again[l / LANES][l % LANES] = reset[from];
        for (long i = 0; i < n; i++)
            a->weight[i * 2 * LANES + l] = observed[from * n + i] ? a->inverse_noise[i] : 0;
    }
    product(s->half, 2 * LANES, n, a->products, n, 1, a->weight, 2 * LANES, a->gathered, 2 * LANES,
            1, 0);
    for (long k = 0; k < 2 && group + k < s->groups; k++) {
        const vec *sum = (const vec *)a->gathered + k;
        vec *to = (vec *)inverse + (group + k) * s->half;
        for (long i = 0; i < m; i++)
            for (long j = 0; j <= i; j++, sum += 2) /* weights of exactly 0 or 1 choose exactly */
                A[i * m + j] = *sum + (1 - again[k]) * a->prior[0][i * s->S + j]
                               + again[k] * a->prior[1][i * s->S + j];
        invert_lanes(m, A, (vec *)a->lower, I, (vec *)(log_det + (group + k) * LANES));
        for (long i = 0; i < m; i++)
            for (long j = 0; j <= i; j++) *to++ = I[i * m + j];
    }
}

#include "propagated.h"

/* Ahead of the loop: the products h_i h_i' and the inverses of all rows. */
static void prepare_information(const Sizes *s, const Ahead *a, const Tape *tape,
                                void *const *prior, const given *noise, const given *H,
                                const uint8_t *observed, const uint8_t *reset, void **p) {
    long n = s->obs, m = s->state, N = s->N, S = s->S;
    real *to = a->products;
    for (int k = 0; k < 2; k++) pack(m, m, prior[k], m, 1, a->prior[k], S);
    take_in(n, m, H, m, 1, a->sensor, S);
    for (long i = 0; i < n; i++)
        a->inverse_noise[i] = 1 / (real)noise[i], a->log_noise[i] = log(noise[i]) + LOG_2PI;
    for (long i = 0; i < m; i++)
        for (long j = 0; j <= i; j++)
            for (long k = 0; k < n; k++) *to++ = a->sensor_t[i * N + k] * a->sensor_t[j * N + k];
    if (s->propagated) propagate(s, a, tape, observed, reset, p[4], p[18], p[19], p[20], p[21]);
    else for (long g = 0; g < s->groups; g += 2)
        gather(s, a, g, observed, reset, tape->inverse, a->log_det);
}

/* One step from the predicted mean and the innovation e of each row, both in `a`: the mean moves by
 * shift = C H' W e, what it leaves is e - H shift, and z = W (e - H shift) = inv(S) e. All are exact
 * zeros where nothing was observed. Without log|P|. e' z as a sum of squares: shift is where it is
 * least, so an error of shift counts by its square alone. */
static void gain_information(const Sizes *s, const Ahead *a, const Tape *tape, long t,
                             const uint8_t *observed, const uint8_t *reset, given *mean, real *ll) {
    long n = s->obs, m = s->state, N = s->N, S = s->S, batch = s->batch, row = t * batch;
    real *z = tape->z + row * N, *shift = tape->shift + row * S;
    for (long b = 0; b < batch; b++)
        for (long i = 0; i < N; i++)
            z[b * N + i] = i < n ? a->error[b * N + i] * a->inverse_noise[i] : 0;
    product(batch, S, n, z, N, 1, a->sensor, S, a->pull, S, 1, 0);
    solve(1, m, S, row, row + batch, tape->inverse, a->pull, a->error_lanes, tape->shift);
    product(batch, N, m, shift, S, 1, a->sensor_t, N, a->fit, N, 1, 0);
    const real *pull = a->pull; /* inv(P) shift */
    if (s->propagated) {
        pull = tape->lifted + row * S;
        solve(1, m, S, row, row + batch, tape->prior, shift, a->error_lanes, tape->lifted);
    } else product_of_two(batch, reset + t, s->time, S, m, shift, S, a->prior, a->pull, S, 0);
    for (long b = 0; b < batch; b++) {
        long at = b * s->time + t;
        real *e = a->error + b * N, *moved = shift + b * S, sum = a->log_det[row + b];
        for (long i = m; i < S; i++) moved[i] = 0;
        for (long i = 0; i < n; i++) {
            int seen = observed[at * n + i];
            real left = seen ? e[i] - a->fit[b * N + i] : 0;
            z[b * N + i] = left * a->inverse_noise[i];
            sum += z[b * N + i] * left + (seen ? a->log_noise[i] : 0);
        }
        for (long i = 0; i < m; i++) sum += moved[i] * pull[b * S + i];
        ll[at] = -0.5 * sum;
        for (long i = 0; i < m; i++) a->mean[b * S + i] += moved[i];
        narrow(m, a->mean + b * S, mean + at * m);
    }
}

/* Ahead of the reverse loop: what every step reads; nothing is summed yet. */
static void begin_information(const Sizes *s, const Back *w, void *const *prior,
                              const given *noise, const given *H) {
    long n = s->obs, m = s->state;
    take_in(m, n, H, 1, m, w->sensor_t, s->N);
    for (long i = 0; i < n; i++) w->inverse_noise[i] = 1 / (real)noise[i];
    for (int k = 0; k < 2; k++) pack(m, m, prior[k], m, 1, w->prior[k], s->S);
    memset(w->by_prior[1], 0, m * s->S * sizeof(real));
    memset(w->g_noise, 0, n * sizeof(real));
}

/* By the innovation through the gain, one step: W H C g. */
static void by_gain_information(const Sizes *s, const Back *w, const Tape *tape, long t,
                                const uint8_t *observed) {
    long n = s->obs, m = s->state, N = s->N, S = s->S, batch = s->batch, row = t * batch;
    real *by = w->error + row * N;
    solve(1, m, S, row, row + batch, tape->inverse, w->filtered + row * S, w->lanes, w->gained);
    product(batch, N, m, w->gained + row * S, S, 1, w->sensor_t, N, by, N, 1, 0);
    if (s->propagated)
        solve(1, m, S, row, row + batch, tape->prior, w->gained + row * S, w->lanes, w->outer);
    for (long b = 0; b < batch; b++)
        for (long i = 0; i < n; i++)
            by[b * N + i] *= observed[(b * s->time + t) * n + i] ? w->inverse_noise[i] : 0;
}

/* By R and by inv(P), one row: what does not wait for the sums over all rows. */
static void by_information(const Sizes *s, Back *w, const Tape *tape, long r,
                           const uint8_t *observed, real half, int again) {
    long m = s->state, S = s->S;
    const real *z = tape->z + r * s->N, *left = w->left + r * s->N, *shift = tape->shift + r * S;
    real *p = w->gained + r * S, *outer = w->outer + r * S;
    for (long i = 0; i < s->obs; i++)
        w->g_noise[i] += z[i] * left[i] - (observed[i] ? half * w->inverse_noise[i] : 0);
    for (long i = m; i < S; i++) p[i] = 0;
    if (s->propagated) { /* by P: (inv(P) p + half inv(P) shift) (inv(P) shift)', and more below */
        for (long i = 0; i < m; i++) outer[i] += half * tape->lifted[r * S + i];
        for (long i = m; i < S; i++) outer[i] = 0;
        w->half[r] = half;
        return;
    }
    for (long i = 0; i < S; i++) outer[i] = -(p[i] + half * shift[i]);
    if (!again) {
        w->half[r] = half;
        return;
    }
    const real *C = tape->inverse + r / LANES * s->half * LANES + r % LANES;
    add_outer(m, m, outer, shift, w->by_prior[1], S);
    for (long i = 0; i < m; i++)
        for (long j = 0; j <= i; j++, C += LANES) {
            w->by_prior[1][i * S + j] -= half * *C;
            if (i > j) w->by_prior[1][j * S + i] -= half * *C;
        }
    memset(outer, 0, S * sizeof(real));
}

/* By the predicted mean: inv(P) (p + g_ll shift), the same as g - H' e of the innovation form but
 * without its difference of large numbers where R is small. */
static void predicted_information(const Sizes *s, const Back *w, const Tape *tape, long t,
                                  const uint8_t *reset, const real *g_ll) {
    long m = s->state, S = s->S, batch = s->batch;
    const real *p = w->gained + t * batch * S, *shift = tape->shift + t * batch * S;
    real *sum = w->step, *to = w->pull;
    if (s->propagated) {
        predicted_propagated(s, w, tape, t, reset);
        return;
    }
    for (long b = 0; b < batch; b++)
        for (long i = 0; i < m; i++)
            sum[b * S + i] = p[b * S + i] + (g_ll ? g_ll[b * s->time + t] : 0) * shift[b * S + i];
    product_of_two(batch, reset + t, s->time, S, m, sum, S, w->prior, to, S, 0);
    for (long b = 0; b < batch; b++)
        memcpy(w->by_predicted + b * s->J, to + b * S, m * sizeof(real));
}

/* sum_t g_t w_ti C_t of every sensor i, lower triangles: [obs, rows] times [rows, state x state]. */
static const real *spread(const Sizes *s, const Back *w, const Tape *tape, const real *g_ll,
                          const uint8_t *observed) {
    long n = s->obs, sensors = (n + BLOCK - 1) / BLOCK * BLOCK, groups = s->groups;
    real *weight = w->spread, *block = weight + sensors * groups * LANES;
    real *out = block + BLOCK * groups * LANES;
    memset(weight, 0, sensors * groups * BYTES);
    for (long r = 0; r < s->rows; r++) { /* [block of sensors][group][sensor][lane] */
        long at = (r % s->batch) * s->time + r / s->batch;
        for (long i = 0; i < n; i++)
            if (observed[at * n + i])
                weight[((i / BLOCK * groups + r / LANES) * BLOCK + i % BLOCK) * LANES + r % LANES] =
                    g_ll[at] * w->inverse_noise[i];
    }
    for (long first = 0; first < s->half; first += BLOCK) {
        long count = s->half - first < BLOCK ? s->half - first : BLOCK;
        if (count < BLOCK) memset(block, 0, BLOCK * groups * BYTES);
        for (long g = 0; g < groups; g++)
            memcpy(block + g * BLOCK * LANES, tape->inverse + (g * s->half + first) * LANES,
                   count * BYTES);
        for (long from = 0; from < n; from += BLOCK) {
            const vec *left = (const vec *)weight + from * groups, *right = (const vec *)block;
            vec sum[BLOCK][BLOCK] = {{{0}}};
            for (long g = 0; g < groups; g++, left += BLOCK, right += BLOCK)
#pragma GCC unroll 4
                for (int i = 0; i < BLOCK; i++)
#pragma GCC unroll 4
                    for (int j = 0; j < BLOCK; j++) sum[i][j] += left[i] * right[j];
            for (long i = 0; i < BLOCK && from + i < n; i++)
                for (long j = 0; j < count; j++)
                    out[(from + i) * s->half + first + j] = over_lanes(sum[i][j]);
        }
    }
    return out;
}

/* By H, R and the two inv(P), once every row is there; g_H and g_noise hold their first parts. */
static void finish_information(const Sizes *s, Back *w, const Tape *tape, const given *H,
                               const real *g_ll, const uint8_t *observed, const uint8_t *reset,
                               void *const *g_prior) {
    real *g_noise = w->g_noise, *g_H = w->g_H;
    long n = s->obs, m = s->state, N = s->N, S = s->S;
    product(n, S, s->rows, tape->z, 1, N, w->gained, S, w->wide, S, 1, 0);
    product(n, S, s->rows, w->error, 1, N, tape->shift, S, w->wide, S, -1, 1);
    for (long i = 0; i < n; i++)
        for (long j = 0; j < m; j++) g_H[i * m + j] += w->wide[i * S + j];
    const real *by = g_ll ? spread(s, w, tape, g_ll, observed) : 0;
    for (long i = 0; i < n && by; i++, by += s->half) {
        const given *h = H + i * m;
        const real *at = by;
        real square = 0;
        for (long j = 0; j < m; j++)
            for (long k = 0; k <= j; k++, at++) {
                g_H[i * m + j] -= *at * h[k];
                if (k < j) g_H[i * m + k] -= *at * h[j];
                square += (k < j ? 2 : 1) * *at * h[j] * h[k];
            }
        g_noise[i] += 0.5 * square * w->inverse_noise[i];
    }
    const vec *sums[2] = {(const vec *)w->sum, (const vec *)w->sum_first};
    const real *right = s->propagated ? tape->lifted : tape->shift;
    product(m, S, s->rows, w->outer, 1, S, right, S, w->by_prior[0], S, 1, 0);
    if (s->propagated) sum_propagated(s, w, tape, reset);
    for (int k = 0; k <= s->propagated; k++)
        for (long i = 0; i < m; i++)
            for (long j = 0; j <= i; j++) {
                real total = over_lanes(*sums[k]++);
                w->by_prior[k][i * S + j] -= total;
                if (i > j) w->by_prior[k][j * S + i] -= total;
            }
    for (int k = 0; k < 2; k++) {
        real *to = g_prior[k];
        for (long i = 0; i < m; i++)
            for (long j = 0; j < m; j++)
                to[i * m + j] = 0.5 * (w->by_prior[k][i * S + j] + w->by_prior[k][j * S + i]);
    }
}
