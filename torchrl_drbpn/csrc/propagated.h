/* A covariance that is propagated: P = F Sigma F' + Q, initial_cov at an episode start, Sigma = C the
 * filtered one of the step before (or what is stored), of LANES sequences at once ahead of the means.
 *
 * F and Sigma are constants of the gradient, so that P adds to it as Q (or initial_cov) does: by P of
 * a row (inv(P) p + half b) b' - half (inv(P) - inv(P) C inv(P)), b = inv(P) shift, p = C g.
 */
#define MAX_VARIANCE 1e6 /* functional/state_space.py says why */

/* Full symmetric matrices of lower triangles. */
static void unfold(long m, const vec *lower, vec *full) {
    for (long i = 0; i < m; i++)
        for (long j = 0; j <= i; j++, lower++) full[i * m + j] = full[j * m + i] = *lower;
}

/* The row of lane l of a group of sequences; the last one stands for those beyond. */
static long sequence_of(const Sizes *s, long group, long l) {
    return group * LANES + l < s->batch ? group * LANES + l : s->batch - 1;
}

/* Put lower triangles of one step's sequences where [rows / LANES][half] keeps them. */
static void scatter(const Sizes *s, long t, long group, const vec *lower, real *to) {
    long first = t * s->batch + group * LANES;
    if (s->batch % LANES == 0) {
        memcpy(to + first / LANES * s->half * LANES, lower, s->half * BYTES);
        return;
    }
    for (long l = 0; l < LANES && group * LANES + l < s->batch; l++) {
        long r = first + l;
        for (long i = 0; i < s->half; i++)
            to[(r / LANES * s->half + i) * LANES + r % LANES] = lower[i][l];
    }
}

/* F Sigma F' into the lower triangle of A, no variance over MAX_VARIANCE. */
static void carry(long m, const real *F, const vec *sigma, vec *moved, vec *A) {
    for (long i = 0; i < m; i++)
        for (long j = 0; j < m; j += BLOCK) {
            vec c[BLOCK] = {{0}};
            long many = m - j < BLOCK ? m - j : BLOCK;
            if (many == BLOCK)
                for (long k = 0; k < m; k++)
#pragma GCC unroll 4
                    for (int r = 0; r < BLOCK; r++) c[r] += F[i * m + k] * sigma[k * m + j + r];
            else
                for (long k = 0; k < m; k++)
                    for (int r = 0; r < many; r++) c[r] += F[i * m + k] * sigma[k * m + j + r];
            for (int r = 0; r < many; r++) moved[i * m + j + r] = c[r];
        }
    vec scale[m];
    int over = 0;
    for (long i = 0; i < m; i++) {
        long j = 0;
        for (; j + BLOCK <= i + 1; j += BLOCK) {
            vec c[BLOCK] = {{0}};
            for (long k = 0; k < m; k++)
#pragma GCC unroll 4
                for (int r = 0; r < BLOCK; r++) c[r] += moved[i * m + k] * F[(j + r) * m + k];
            for (int r = 0; r < BLOCK; r++) A[i * m + j + r] = c[r];
        }
        for (; j <= i; j++) {
            vec c = {0};
            for (long k = 0; k < m; k++) c += moved[i * m + k] * F[j * m + k];
            A[i * m + j] = c;
        }
        vec own = A[i * m + i];
        for (long l = 0; l < LANES; l++) {
            over |= own[l] > MAX_VARIANCE;
            scale[i][l] = own[l] > MAX_VARIANCE ? sqrt(MAX_VARIANCE / own[l]) : 1;
        }
    }
    for (long i = 0; i < m && over; i++)
        for (long j = 0; j <= i; j++) A[i * m + j] *= scale[i] * scale[j];
}

/* The recursion over all steps: inv(P) and C of every row onto the tape, log|P| + log|inv(C)|, and
 * the filtered covariances for the caller, whose diagonal is raised by what rounding may take. */
static void propagate(const Sizes *s, const Ahead *a, const Tape *tape, const uint8_t *observed,
                      const uint8_t *reset, const uint8_t *use_stored, const given *F,
                      const given *start, const given *stored, given *out) {
    long n = s->obs, m = s->state, half = s->half, groups = (s->batch + LANES - 1) / LANES;
    vec *A = (vec *)a->factor, *I = (vec *)a->square, *full = (vec *)a->before;
    vec *kept = (vec *)a->kept, *gathered = (vec *)a->gathered;
    real raise = 1 + 0.5 * m * (sizeof(given) == 4 ? FLT_EPSILON : DBL_EPSILON);
    widen(m * m, F, a->jacobian);
    /* lanes beyond the last row take part in sums, with weight 0 */
    memset(tape->inverse + (s->groups - 1) * half * LANES, 0, half * BYTES);
    memset(tape->prior + (s->groups - 1) * half * LANES, 0, half * BYTES);
    for (long t = 0; t < s->time; t++)
        for (long g = 0; g < groups; g++) {
            vec again = {0}, any = {0}, det, more, *sigma = (vec *)a->sigma + g * half;
            if (t) unfold(m, sigma, full);
            for (long l = 0; l < LANES; l++) {
                long b = sequence_of(s, g, l), at = b * s->time + t;
                const given *from = t ? 0 : start + b * m * m;
                again[l] = reset[at] != 0;
                if (use_stored && use_stored[at]) from = stored + at * m * m;
                for (long i = 0; i < m * m && (reset[at] || from); i++)
                    full[i][l] = reset[at] ? 0 : from[i];
                for (long i = 0; i < n; i++) {
                    int seen = observed[at * n + i] != 0;
                    a->weight[i * LANES + l] = seen ? a->inverse_noise[i] : 0;
                    any[l] += seen;
                }
            }
            carry(m, a->jacobian, full, (vec *)a->moved, A);
            for (long i = 0, k = 0; i < m; i++)
                for (long j = 0; j <= i; j++, k++) {
                    long at = i * s->S + j;
                    A[i * m + j] += (1 - again) * a->prior[0][at] + again * a->prior[1][at];
                    kept[k] = A[i * m + j];
                }
            invert_lanes(m, A, (vec *)a->lower, I, &det);
            product(half, LANES, n, a->products, n, 1, a->weight, LANES, a->gathered, LANES, 1, 0);
            for (long i = 0, k = 0; i < m; i++)
                for (long j = 0; j <= i; j++, k++) {
                    A[i * m + j] = gathered[k] + I[i * m + j];
                    gathered[k] = I[i * m + j];
                }
            scatter(s, t, g, gathered, tape->prior);
            invert_lanes(m, A, (vec *)a->lower, I, &more);
            for (long i = 0, k = 0; i < m; i++)
                for (long j = 0; j <= i; j++, k++)
                    for (long l = 0; l < LANES; l++) /* exactly P where nothing was observed */
                        sigma[k][l] = any[l] ? I[i * m + j][l] : kept[k][l];
            scatter(s, t, g, sigma, tape->inverse);
            for (long l = 0; l < LANES && g * LANES + l < s->batch; l++) {
                long b = g * LANES + l;
                given *to = out + (b * s->time + t) * m * m;
                a->log_det[t * s->batch + b] = det[l] + more[l];
                for (long i = 0, k = 0; i < m; i++)
                    for (long j = 0; j <= i; j++, k++)
                        to[i * m + j] = to[j * m + i] = sigma[k][l] * (i == j ? raise : 1);
            }
        }
}

/* By the predicted mean, one step: inv(P) p + g_ll b; and by initial_cov where an episode starts. */
static void predicted_propagated(const Sizes *s, const Back *w, const Tape *tape, long t,
                                 const uint8_t *reset) {
    long m = s->state, S = s->S;
    for (long b = 0; b < s->batch; b++) {
        long r = t * s->batch + b;
        real *outer = w->outer + r * S;
        const real *lifted = tape->lifted + r * S;
        for (long i = 0; i < m; i++)
            w->by_predicted[b * s->J + i] = outer[i] + w->half[r] * lifted[i];
        if (!reset[b * s->time + t]) continue;
        add_outer(m, m, outer, lifted, w->by_prior[1], S);
        memset(outer, 0, S * sizeof(real));
    }
}

/* sum half (inv(P) - inv(P) C inv(P)) of all rows: of ordinary ones, and of episode starts. */
static void sum_propagated(const Sizes *s, const Back *w, const Tape *tape, const uint8_t *reset) {
    long m = s->state, half = s->half;
    vec *prior = (vec *)w->full[0], *times = (vec *)w->full[1];
    vec *sum = (vec *)w->sum, *first = (vec *)w->sum_first;
    memset(sum, 0, half * BYTES), memset(first, 0, half * BYTES);
    for (long g = 0; g < s->groups; g++) {
        vec weight = *(vec *)(w->half + g * LANES), again = {0};
        real total = 0;
        for (long l = 0; l < LANES && g * LANES + l < s->rows; l++) {
            long r = g * LANES + l;
            again[l] = reset[(r % s->batch) * s->time + r / s->batch] != 0;
            total += weight[l] != 0;
        }
        if (!(total > 0)) continue;
        const vec *lower = (const vec *)tape->prior + g * half;
        const vec *C = (const vec *)tape->inverse + g * half;
        unfold(m, lower, prior);
        /* inv(P) C, C by its lower triangle */
        for (long i = 0; i < m; i++)
            for (long j = 0; j < m; j++) {
                vec c = {0}, c2 = {0};
                const vec *row = C + j * (j + 1) / 2, *below = row + j;
                for (long k = 0; k < j; k++) c += prior[i * m + k] * row[k];
                for (long k = j; k < m; below += ++k) c2 += prior[i * m + k] * *below;
                times[i * m + j] = c + c2;
            }
        for (long i = 0, e = 0; i < m; i++)
            for (long j = 0; j <= i; j++, e++) {
                vec c = {0}, c2 = {0};
                long k = 0;
                for (; k + 1 < m; k += 2) {
                    c += times[i * m + k] * prior[j * m + k];
                    c2 += times[i * m + k + 1] * prior[j * m + k + 1];
                }
                if (k < m) c += times[i * m + k] * prior[j * m + k];
                vec left = weight * (lower[e] - c - c2);
                sum[e] += (1 - again) * left, first[e] += again * left;
            }
    }
}
