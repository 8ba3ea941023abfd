/* The belief filter over [batch, time] and its reverse pass as two functions, for a constant Q, eq.
 * (8), (10), (12) [DRBPN]. The same sums as recurrence.py, where PyTorch needs some hundred small
 * operations a minibatch. compiled.py compiles this file, once for each `real`.
 *
 * Innovation and information form differ in how z = inv(S) (y - H m) and the gain of a row come
 * about: by inv(S), obs x obs, or by C = inv(inv(P) + sum_i w_i h_i h_i'), state x state. The loops
 * are the same: the mean moves by P H' z = C H' W (y - H m), and back.
 *
 * Inside, row r = t * batch + b is step t of sequence b, and every row of a matrix is padded with
 * zeros to whole vectors (capitals: N, S, J are obs, state, state + action, padded). What differs
 * from step to step, the innovation covariance of each mask, is factorised for LANES rows at once:
 * entry (i, j) of LANES matrices is one vector, so the textbook loops are the vectorised ones.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef REAL
#define REAL float
#endif
typedef REAL real;
#define BYTES 64
#define LANES ((long)(BYTES / sizeof(real)))
#define MAX_LAYERS 16
#define BLOCK 4
typedef real vec __attribute__((vector_size(BYTES), aligned(sizeof(real)), may_alias));
#define LOG_2PI ((real)1.8378770664093453)
#define INLINE static inline __attribute__((always_inline))

INLINE long padded(long n) { return (n + LANES - 1) / LANES * LANES; }

/* ---------------------------------------------------------------- matrix products */

/* C (+)= A B for ROWS x (COLS * LANES) entries of C, which stay in registers. */
INLINE void tile(const int rows, const int cols, long inner, const real *A, long a_row, long a_in,
                 const real *B, long ldb, real *C, long ldc, real sign, int add) {
    vec acc[4][2];
#pragma GCC unroll 4
    for (int r = 0; r < rows; r++)
#pragma GCC unroll 2
        for (int c = 0; c < cols; c++) acc[r][c] = (vec){0};
    for (long k = 0; k < inner; k++) {
        vec b[2];
#pragma GCC unroll 2
        for (int c = 0; c < cols; c++) b[c] = *(const vec *)(B + k * ldb + c * LANES);
#pragma GCC unroll 4
        for (int r = 0; r < rows; r++)
#pragma GCC unroll 2
            for (int c = 0; c < cols; c++) acc[r][c] += A[r * a_row + k * a_in] * b[c];
    }
#pragma GCC unroll 4
    for (int r = 0; r < rows; r++)
#pragma GCC unroll 2
        for (int c = 0; c < cols; c++) {
            vec *to = (vec *)(C + r * ldc + c * LANES);
            *to = add ? *to + sign * acc[r][c] : sign * acc[r][c];
        }
}

/* C[m][n] = (add ? C[m][n] : 0) + sign * sum_k A[m a_row + k a_in] B[k ldb + n]; n padded. */
static void product(long m, long n, long inner, const real *A, long a_row, long a_in, const real *B,
                    long ldb, real *C, long ldc, real sign, int add) {
    for (long j = 0; j < n;) {
        long wide = n - j >= 2 * LANES, i = 0;
        for (; i + 4 <= m; i += 4) {
            const real *a = A + i * a_row;
            if (wide) tile(4, 2, inner, a, a_row, a_in, B + j, ldb, C + i * ldc + j, ldc, sign, add);
            else tile(4, 1, inner, a, a_row, a_in, B + j, ldb, C + i * ldc + j, ldc, sign, add);
        }
        for (; i < m; i++) {
            const real *a = A + i * a_row;
            if (wide) tile(1, 2, inner, a, a_row, a_in, B + j, ldb, C + i * ldc + j, ldc, sign, add);
            else tile(1, 1, inner, a, a_row, a_in, B + j, ldb, C + i * ldc + j, ldc, sign, add);
        }
        j += wide ? 2 * LANES : LANES;
    }
}

/* to[r][c] = from[r * row + c * col], columns from `cols` to `ld` zero. */
static void pack(long rows, long cols, const real *from, long row, long col, real *to, long ld) {
    for (long r = 0; r < rows; r++) {
        for (long c = 0; c < cols; c++) to[r * ld + c] = from[r * row + c * col];
        for (long c = cols; c < ld; c++) to[r * ld + c] = 0;
    }
}

static void unpack(long rows, long cols, const real *from, long ld, real *to) {
    for (long r = 0; r < rows; r++) memcpy(to + r * cols, from + r * ld, cols * sizeof(real));
}

/* ---------------------------------------------------------------- sizes and memory */

typedef struct {
    long batch, time, obs, state, action, layers, residual, relu, full_noise, start_stride,
        information;
    long width[MAX_LAYERS + 1], W[MAX_LAYERS + 1]; /* of layer outputs; 0: (state, action) */
    long N, S, J, rows, groups, half; /* half: entries of a lower triangle, state x state */
    long entries;                     /* kept of an inverse */
} Sizes;

static Sizes read_sizes(const int64_t *d) {
    Sizes z = {d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8], d[9], d[10]};
    z.width[0] = z.state + z.action;
    for (long i = 1; i <= z.layers; i++) z.width[i] = d[10 + i];
    for (long i = 0; i <= z.layers; i++) z.W[i] = padded(z.width[i]);
    z.N = padded(z.obs), z.S = padded(z.state), z.J = z.W[0];
    z.rows = z.batch * z.time, z.groups = (z.rows + LANES - 1) / LANES;
    z.half = z.state * (z.state + 1) / 2;
    z.entries = z.information ? z.half : z.obs * z.obs;
    return z;
}

typedef struct { real *base; long used; } Memory;

static real *take(Memory *m, long count) {
    long at = m->used;
    m->used += padded(count);
    return m->base ? m->base + at : 0;
}

typedef struct { /* what the reverse pass reads, all but inverse as [rows][padded] */
    real *input, *predicted, *hidden[MAX_LAYERS], *z, *inverse, *cross[2], *cross_t[2], *shift;
} Tape;

static Tape lay_tape(const Sizes *s, Memory *m) {
    Tape t;
    t.input = take(m, s->rows * s->J), t.predicted = take(m, s->rows * s->J);
    for (long i = 1; i < s->layers; i++) t.hidden[i] = take(m, s->rows * s->W[i]);
    t.z = take(m, s->rows * s->N);
    t.inverse = take(m, s->groups * s->entries * LANES);
    if (s->information) t.shift = take(m, s->rows * s->S);
    else for (int k = 0; k < 2; k++) {
        t.cross[k] = take(m, s->state * s->N);
        t.cross_t[k] = take(m, s->obs * s->S);
    }
    return t;
}

typedef struct {
    real *weight_t[MAX_LAYERS + 1], *bias[MAX_LAYERS + 1], *sensor_t, *offset, *cov[2], *factor,
        *lower, *error, *error_lanes, *log_det, *mean, *step, *sensor, *inverse_noise, *log_noise,
        *products, *weight, *gathered, *square, *pull, *fit, *prior[2];
} Ahead;

static Ahead lay_ahead(const Sizes *s, Memory *m) {
    Ahead a;
    for (long i = 1; i <= s->layers; i++) {
        a.weight_t[i] = take(m, s->width[i - 1] * s->W[i]);
        a.bias[i] = take(m, s->W[i]);
    }
    a.sensor_t = take(m, s->width[0] * s->N), a.offset = take(m, s->N);
    long n = s->information ? s->state : s->obs;
    if (s->information) {
        a.sensor = take(m, s->obs * s->S);
        a.inverse_noise = take(m, s->obs), a.log_noise = take(m, s->obs);
        a.products = take(m, s->half * s->obs), a.weight = take(m, s->obs * 2 * LANES);
        a.gathered = take(m, s->half * 2 * LANES), a.square = take(m, n * n * LANES);
        a.pull = take(m, s->batch * s->S), a.fit = take(m, s->batch * s->N);
        a.prior[0] = take(m, n * s->S), a.prior[1] = take(m, n * s->S);
    } else a.cov[0] = take(m, s->obs * s->N), a.cov[1] = take(m, s->obs * s->N);
    a.factor = take(m, n * n * LANES), a.lower = take(m, n * n * LANES);
    a.error = take(m, s->batch * s->N), a.error_lanes = take(m, n * LANES);
    a.log_det = take(m, s->groups * LANES);
    a.mean = take(m, s->batch * s->S), a.step = take(m, s->batch * s->S);
    return a;
}

/* Of `spread` below: blocks of weights, one block of inverses, sums of half an inverse a sensor. */
static long spread_size(const Sizes *s) {
    long sensors = (s->obs + BLOCK - 1) / BLOCK * BLOCK;
    return (sensors + BLOCK) * s->groups * LANES + s->obs * s->half;
}

typedef struct {
    real *weight[MAX_LAYERS + 1], *layer[MAX_LAYERS + 1], *sensor, *noise_prior[2], *filtered,
        *error, *left, *half, *lanes, *sum, *carry, *by_predicted, *by_input, *cross[2], *cov[2],
        *square, *wide, *sensor_t, *inverse_noise, *gained, *prior[2],
        *by_prior[2], *outer, *pull, *step, *spread;
} Back;

static Back lay_back(const Sizes *s, Memory *m) {
    Back b;
    long widest = s->J > s->N ? s->J : s->N;
    for (long i = 1; i <= s->layers; i++) {
        b.weight[i] = take(m, s->width[i] * s->W[i - 1]);
        b.layer[i] = take(m, s->rows * s->W[i]);
        widest = s->W[i] > widest ? s->W[i] : widest;
    }
    b.sensor = take(m, s->obs * s->J);
    b.filtered = take(m, s->rows * s->S), b.error = take(m, s->rows * s->N);
    b.left = take(m, s->rows * s->N), b.half = take(m, s->groups * LANES);
    b.lanes = take(m, (s->information ? s->state : s->obs) * LANES);
    b.sum = take(m, s->entries * LANES);
    b.carry = take(m, s->batch * s->S);
    b.by_predicted = take(m, s->batch * s->J), b.by_input = take(m, s->batch * s->J);
    if (s->information) {
        b.sensor_t = take(m, s->state * s->N), b.inverse_noise = take(m, s->obs);
        b.gained = take(m, s->rows * s->S), b.outer = take(m, s->rows * s->S);
        for (int k = 0; k < 2; k++) {
            b.prior[k] = take(m, s->state * s->S), b.by_prior[k] = take(m, s->state * s->S);
        }
        b.pull = take(m, s->batch * s->S), b.step = take(m, s->batch * s->S);
        b.spread = take(m, spread_size(s));
    } else {
        for (int k = 0; k < 2; k++) {
            b.noise_prior[k] = take(m, s->state * s->S);
            b.cross[k] = take(m, s->state * s->N), b.cov[k] = take(m, s->obs * s->N);
        }
        b.square = take(m, s->obs * s->N);
    }
    b.wide = take(m, widest * widest);
    return b;
}

/* Reals that the caller allocates: tape, scratch of forward, scratch of backward. */
void sizes(const int64_t *dims, int64_t *out) {
    Sizes s = read_sizes(dims);
    Memory tape = {0}, ahead = {0}, back = {0};
    lay_tape(&s, &tape), lay_ahead(&s, &ahead), lay_back(&s, &back);
    out[0] = tape.used, out[1] = ahead.used, out[2] = back.used;
}

/* ---------------------------------------------------------------- the innovation covariances */

/* Rows i .. i + many of column j of the factor. */
INLINE void column(const int many, long n, long i, long j, vec *A, const vec *X) {
    vec c[BLOCK];
#pragma GCC unroll 4
    for (int r = 0; r < many; r++) c[r] = A[(i + r) * n + j];
    for (long k = 0; k < j; k++)
#pragma GCC unroll 4
        for (int r = 0; r < many; r++) c[r] -= A[(i + r) * n + k] * A[j * n + k];
#pragma GCC unroll 4
    for (int r = 0; r < many; r++) A[(i + r) * n + j] = c[r] * X[j * n + j];
}

/* Entries j .. j + many of row i of the factor's inverse; the rows above are there. */
INLINE void inverse_row(const int many, long n, long i, long j, const vec *A, vec *X) {
    vec c[BLOCK];
#pragma GCC unroll 4
    for (int r = 0; r < many; r++) c[r] = (vec){0};
    for (long k = j; k < i; k++)
#pragma GCC unroll 4
        for (int r = 0; r < many; r++) c[r] -= A[i * n + k] * X[k * n + j + r];
#pragma GCC unroll 4
    for (int r = 0; r < many; r++) {
        if (i > j + r) X[i * n + j + r] = c[r] * X[i * n + i];
        if (i < j + r) X[i * n + j + r] = (vec){0};
    }
}

/* Entries (i, j .. j + many) of X' X, and their mirror images. */
INLINE void square(const int many, long n, long i, long j, const vec *X, vec *I) {
    vec c[BLOCK];
#pragma GCC unroll 4
    for (int r = 0; r < many; r++) c[r] = (vec){0};
    for (long k = i; k < n; k++)
#pragma GCC unroll 4
        for (int r = 0; r < many; r++) c[r] += X[k * n + i] * X[k * n + j + r];
#pragma GCC unroll 4
    for (int r = 0; r < many; r++) I[i * n + j + r] = I[(j + r) * n + i] = c[r];
}

/* I = inv(A), det = log|A| of LANES matrices; A holds lower triangles and becomes their factors. A
 * matrix that cannot be factorised becomes NaN alone. */
static void invert_lanes(long n, vec *A, vec *X, vec *I, vec *det) {
    vec sum = {0};
    for (long j = 0; j < n; j++) { /* BLOCK sums at once: one alone would wait for itself */
        vec c = A[j * n + j];
        for (long k = 0; k < j; k++) c -= A[j * n + k] * A[j * n + k];
        for (long l = 0; l < LANES; l++) c[l] = sizeof(real) == 4 ? sqrtf(c[l]) : sqrt(c[l]);
        for (long l = 0; l < LANES; l++)
            sum[l] += 2 * (sizeof(real) == 4 ? logf(c[l]) : log(c[l]));
        A[j * n + j] = c, X[j * n + j] = 1 / c;
        long i = j + 1;
        for (; i + BLOCK <= n; i += BLOCK) column(BLOCK, n, i, j, A, X);
        for (; i < n; i++) column(1, n, i, j, A, X);
    }
    *det = sum;
    for (long j = 0; j < n; j += BLOCK) { /* X = inv(factor), zero above its diagonal */
        long wide = n - j < BLOCK ? n - j : BLOCK;
        for (long i = j; i < n; i++)
            if (wide == BLOCK) inverse_row(BLOCK, n, i, j, A, X);
            else for (long k = j; k < n; k++) inverse_row(1, n, i, k, A, X);
    }
    for (long i = 0; i < n; i++) { /* X' X */
        long j = 0;
        for (; j + BLOCK <= i + 1; j += BLOCK) square(BLOCK, n, i, j, X, I);
        for (; j <= i; j++) square(1, n, i, j, X, I);
    }
}

/* The same for `count` whole matrices in rows, for the forms that are not in this file. */
void spd_inverse(long n, long count, const real *matrix, real *inverse, real *log_det,
                 real *scratch) {
    real *A = scratch, *X = A + n * n * LANES, *I = X + n * n * LANES;
    for (long first = 0; first < count; first += LANES) {
        vec det;
        for (long l = 0; l < LANES; l++) {
            const real *from = matrix + (first + l < count ? first + l : count - 1) * n * n;
            for (long i = 0; i < n; i++)
                for (long j = 0; j <= i; j++) A[(i * n + j) * LANES + l] = from[i * n + j];
        }
        invert_lanes(n, (vec *)A, (vec *)X, (vec *)I, &det);
        for (long l = 0; l < LANES && first + l < count; l++) {
            real *to = inverse + (first + l) * n * n;
            for (long i = 0; i < n * n; i++) to[i] = I[i * LANES + l];
            log_det[first + l] = det[l];
        }
    }
}

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

/* out[r] = inverse_r in[r] for the rows of one step; `in` starts at its first row. */
static void solve(const Sizes *s, long t, const real *inverse, const real *in, real *lanes,
                  real *out) {
    long n = s->information ? s->state : s->obs, ld = s->information ? s->S : s->N;
    long first = t * s->batch, last = first + s->batch;
    vec *e = (vec *)lanes;
    for (long group = first / LANES; group * LANES < last; group++) {
        long low = group * LANES > first ? group * LANES : first;
        long high = (group + 1) * LANES < last ? (group + 1) * LANES : last;
        if (high - low < LANES) memset(lanes, 0, n * BYTES);
        for (long r = low; r < high; r++)
            for (long i = 0; i < n; i++) lanes[i * LANES + r % LANES] = in[(r - first) * ld + i];
        const vec *I = (const vec *)inverse + group * s->entries;
        for (long i = 0; i < n; i++) {
            vec c = {0}, c2 = {0};
            if (s->information) { /* a lower triangle, row after row */
                const vec *row = I + i * (i + 1) / 2, *below = row + i;
                for (long j = 0; j < i; j++) c += row[j] * e[j];
                for (long j = i; j < n; below += ++j) c2 += *below * e[j];
            } else {
                long j = 0;
                for (; j + 1 < n; j += 2)
                    c += I[i * n + j] * e[j], c2 += I[i * n + j + 1] * e[j + 1];
                if (j < n) c += I[i * n + j] * e[j];
            }
            c += c2;
            for (long r = low; r < high; r++) out[r * ld + i] = c[r % LANES];
        }
    }
}

/* ---------------------------------------------------------------- forward */

/* One step from the predicted mean and the innovation e of each row, both in `a`: the mean moves by
 * shift = C H' W e, what it leaves is e - H shift, and z = W (e - H shift) = inv(S) e. All are exact
 * zeros where nothing was observed. Without log|P|. e' z as a sum of squares: shift is where it is
 * least, so an error of shift counts by its square alone. */
static void gain_information(const Sizes *s, const Ahead *a, const Tape *tape, long t,
                             const uint8_t *observed, const uint8_t *reset, real *mean, real *ll) {
    long n = s->obs, m = s->state, N = s->N, S = s->S, batch = s->batch, row = t * batch;
    real *z = tape->z + row * N, *shift = tape->shift + row * S;
    for (long b = 0; b < batch; b++)
        for (long i = 0; i < N; i++)
            z[b * N + i] = i < n ? a->error[b * N + i] * a->inverse_noise[i] : 0;
    product(batch, S, n, z, N, 1, a->sensor, S, a->pull, S, 1, 0);
    solve(s, t, tape->inverse, a->pull, a->error_lanes, tape->shift);
    product(batch, N, m, shift, S, 1, a->sensor_t, N, a->fit, N, 1, 0);
    for (long b = 0; b < batch;) {
        long first = b, k = reset[b * s->time + t] != 0;
        while (b < batch && (reset[b * s->time + t] != 0) == k) b++;
        product(b - first, S, m, shift + first * S, S, 1, a->prior[k], S, a->pull + first * S, S, 1,
                0);
    }
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
        for (long i = 0; i < m; i++) sum += moved[i] * a->pull[b * S + i];
        ll[at] = (real)-0.5 * sum;
        for (long i = 0; i < m; i++) mean[at * m + i] = a->mean[b * S + i] += moved[i];
    }
}

void forward(const int64_t *dims, void **p) {
    Sizes z = read_sizes(dims), *s = &z;
    const real *x = p[0], *action = p[2], *stored = p[5], *start = p[6], *cov[2] = {p[7], p[8]};
    const real *noise = p[9], *H = p[10], *B = p[11], *d = p[12], *initial = p[13];
    const uint8_t *observed = p[1], *reset = p[3], *restart = p[4];
    real *mean = p[14], *ll = p[15];
    Memory kept = {p[16], 0}, scratch = {p[17], 0};
    Tape tape = lay_tape(s, &kept);
    Ahead a = lay_ahead(s, &scratch);
    long n = s->obs, m = s->state, width = s->width[0], N = s->N, S = s->S, J = s->J;
    long batch = s->batch, time = s->time;

    for (long i = 1; i <= s->layers; i++) {
        const real *weight = p[16 + 2 * i], *bias = p[17 + 2 * i];
        pack(s->width[i - 1], s->width[i], weight, 1, s->width[i - 1], a.weight_t[i], s->W[i]);
        pack(1, s->width[i], bias, 0, 1, a.bias[i], s->W[i]);
    }
    pack(m, n, H, 1, m, a.sensor_t, N);
    pack(s->action, n, B, 1, s->action, a.sensor_t + m * N, N);
    pack(1, n, d, 0, 1, a.offset, N);
    if (s->information) {
        real *to = a.products;
        for (int k = 0; k < 2; k++) pack(m, m, cov[k], m, 1, a.prior[k], S); /* inverses, here */
        pack(n, m, H, m, 1, a.sensor, S);
        for (long i = 0; i < n; i++)
            a.inverse_noise[i] = 1 / noise[i], a.log_noise[i] = log(noise[i]) + LOG_2PI;
        for (long i = 0; i < m; i++)
            for (long j = 0; j <= i; j++)
                for (long k = 0; k < n; k++) *to++ = a.sensor_t[i * N + k] * a.sensor_t[j * N + k];
        for (long g = 0; g < s->groups; g += 2)
            gather(s, &a, g, observed, reset, tape.inverse, a.log_det);
    } else for (int k = 0; k < 2; k++) { /* P H' and H P H' + R, P = Q or initial_cov */
        product(m, N, m, cov[k], m, 1, a.sensor_t, N, tape.cross[k], N, 1, 0);
        pack(n, m, tape.cross[k], 1, N, tape.cross_t[k], S);
        if (s->full_noise) pack(n, n, noise, n, 1, a.cov[k], N);
        else {
            memset(a.cov[k], 0, n * N * sizeof(real));
            for (long i = 0; i < n; i++) a.cov[k][i * N + i] = noise[i];
        }
        product(n, N, m, H, m, 1, tape.cross[k], N, a.cov[k], N, 1, 1);
    }
    for (long g = 0; g < s->groups && !s->information; g++)
        invert(s, &a, g, observed, reset, tape.inverse + g * n * n * LANES, a.log_det + g * LANES);

    for (long t = 0; t < time; t++) {
        long row = t * batch;
        real *input = tape.input + row * J, *predicted = tape.predicted + row * J;
        for (long b = 0; b < batch; b++) {
            const real *from = a.mean + b * S;
            if (t == 0) from = start + b * s->start_stride;
            if (restart && restart[b * time + t]) from = stored + (b * time + t) * m;
            memcpy(input + b * J, from, m * sizeof(real));
            const real *moved = action + (b * time + t) * s->action;
            memcpy(input + b * J + m, moved, s->action * sizeof(real));
            memset(input + b * J + width, 0, (J - width) * sizeof(real));
            memcpy(predicted + b * J, input + b * J, J * sizeof(real));
        }
        const real *h = input;
        for (long i = 1; i <= s->layers; i++) {
            long wide = s->W[i];
            real *out = i < s->layers ? tape.hidden[i] + row * wide : a.step;
            for (long b = 0; b < batch; b++) memcpy(out + b * wide, a.bias[i], wide * sizeof(real));
            product(batch, wide, s->width[i - 1], h, s->W[i - 1], 1, a.weight_t[i], wide, out, wide,
                    1, 1);
            if (i < s->layers) {
                if (s->relu) for (long k = 0; k < batch * wide; k++) out[k] = out[k] < 0 ? 0 : out[k];
                else for (long k = 0; k < batch * wide; k++) out[k] = tanh(out[k]);
            }
            h = out;
        }
        for (long b = 0; b < batch; b++) {
            real *to = predicted + b * J, *out = a.mean + b * S, *e = a.error + b * N;
            for (long i = 0; i < m; i++) {
                real moved = a.step[b * S + i] + (s->residual ? input[b * J + i] : 0);
                to[i] = out[i] = reset[b * time + t] ? initial[i] : moved;
            }
            memcpy(e, a.offset, N * sizeof(real));
        }
        product(batch, N, width, predicted, J, 1, a.sensor_t, N, a.error, N, 1, 1);
        for (long b = 0; b < batch; b++) {
            long at = (b * time + t) * n;
            real *e = a.error + b * N;
            for (long i = 0; i < n; i++) e[i] = observed[at + i] ? x[at + i] - e[i] : 0;
        }
        real *gained = tape.z + row * N;
        if (s->information) {
            gain_information(s, &a, &tape, t, observed, reset, mean, ll);
            continue;
        }
        solve(s, t, tape.inverse, a.error, a.error_lanes, tape.z);
        /* a.mean holds the predicted mean: add P H' z, of the P that the row started from */
        for (long b = 0; b < batch; b++) {
            real *at = gained + b * N;
            for (long i = n; i < N; i++) at[i] = 0;
        }
        for (long b = 0; b < batch;) {
            long first = b, k = reset[b * time + t] != 0;
            while (b < batch && (reset[b * time + t] != 0) == k) b++;
            product(b - first, S, n, gained + first * N, N, 1, tape.cross_t[k], S,
                    a.mean + first * S, S, 1, 1);
        }
        for (long b = 0; b < batch; b++) {
            long at = b * time + t, count = 0;
            real quadratic = 0;
            for (long i = 0; i < n; i++) {
                quadratic += gained[b * N + i] * a.error[b * N + i];
                count += observed[at * n + i];
            }
            ll[at] = count ? (real)-0.5 * (quadratic + a.log_det[row + b] + count * LOG_2PI) : 0;
            memcpy(mean + at * m, a.mean + b * S, m * sizeof(real));
        }
    }
}

/* ---------------------------------------------------------------- backward */

static void add_outer(long rows, long cols, const real *left, const real *right, real *to, long ld) {
    for (long i = 0; i < rows; i++)
        for (long j = 0; j < cols; j++) to[i * ld + j] += left[i] * right[j];
}

INLINE real over_lanes(vec v) {
    real sum = 0;
    for (long l = 0; l < LANES; l++) sum += v[l];
    return sum;
}

/* By R and by inv(P), one row: what does not wait for the sums over all rows. */
static void by_information(const Sizes *s, Back *w, const Tape *tape, long r,
                           const uint8_t *observed, real half, int again, real *g_noise) {
    long m = s->state, S = s->S;
    const real *z = tape->z + r * s->N, *left = w->left + r * s->N, *shift = tape->shift + r * S;
    real *p = w->gained + r * S, *outer = w->outer + r * S;
    for (long i = 0; i < s->obs; i++)
        g_noise[i] += z[i] * left[i] - (observed[i] ? half * w->inverse_noise[i] : 0);
    for (long i = m; i < S; i++) p[i] = 0;
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
    for (long b = 0; b < batch; b++)
        for (long i = 0; i < m; i++)
            sum[b * S + i] = p[b * S + i] + (g_ll ? g_ll[b * s->time + t] : 0) * shift[b * S + i];
    for (long b = 0; b < batch;) {
        long first = b, k = reset[b * s->time + t] != 0;
        while (b < batch && (reset[b * s->time + t] != 0) == k) b++;
        product(b - first, S, m, sum + first * S, S, 1, w->prior[k], S, to + first * S, S, 1, 0);
    }
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
static void finish_information(const Sizes *s, Back *w, const Tape *tape, const real *H,
                               const real *g_ll, const uint8_t *observed, real **g_prior,
                               real *g_noise, real *g_H) {
    long n = s->obs, m = s->state, N = s->N, S = s->S;
    product(n, S, s->rows, tape->z, 1, N, w->gained, S, w->wide, S, 1, 0);
    product(n, S, s->rows, w->error, 1, N, tape->shift, S, w->wide, S, -1, 1);
    for (long i = 0; i < n; i++)
        for (long j = 0; j < m; j++) g_H[i * m + j] += w->wide[i * S + j];
    const real *by = g_ll ? spread(s, w, tape, g_ll, observed) : 0;
    for (long i = 0; i < n && by; i++, by += s->half) {
        const real *h = H + i * m, *at = by;
        real square = 0;
        for (long j = 0; j < m; j++)
            for (long k = 0; k <= j; k++, at++) {
                g_H[i * m + j] -= *at * h[k];
                if (k < j) g_H[i * m + k] -= *at * h[j];
                square += (k < j ? 2 : 1) * *at * h[j] * h[k];
            }
        g_noise[i] += (real)0.5 * square * w->inverse_noise[i];
    }
    product(m, S, s->rows, w->outer, 1, S, tape->shift, S, w->by_prior[0], S, 1, 0);
    const vec *sum = (const vec *)w->sum;
    for (long i = 0; i < m; i++)
        for (long j = 0; j <= i; j++) {
            real total = over_lanes(*sum++);
            w->by_prior[0][i * S + j] -= total;
            if (i > j) w->by_prior[0][j * S + i] -= total;
        }
    for (int k = 0; k < 2; k++)
        for (long i = 0; i < m; i++)
            for (long j = 0; j < m; j++)
                g_prior[k][i * m + j] =
                    (real)0.5 * (w->by_prior[k][i * S + j] + w->by_prior[k][j * S + i]);
}

void backward(const int64_t *dims, void **p) {
    Sizes z = read_sizes(dims), *s = &z;
    const real *g_mean = p[0], *g_ll = p[1], *cov[2] = {p[4], p[5]}, *H = p[6], *B = p[7];
    const uint8_t *reset = p[2], *restart = p[3];
    Memory kept = {p[8], 0}, scratch = {p[9], 0};
    real *g_x = p[10], *g_action = p[11], *g_stored = p[12], *g_start = p[13];
    real *g_cov[2] = {p[14], p[15]}, *g_noise = p[16], *g_H = p[17], *g_B = p[18], *g_d = p[19];
    real *g_initial = p[20];
    const uint8_t *observed = p[21];
    const real *noise = p[22];
    Tape tape = lay_tape(s, &kept);
    Back w = lay_back(s, &scratch);
    long n = s->obs, m = s->state, width = s->width[0], N = s->N, S = s->S, J = s->J;
    long batch = s->batch, time = s->time, last = s->layers;

    for (long i = 1; i <= last; i++)
        pack(s->width[i], s->width[i - 1], p[22 + i], s->width[i - 1], 1, w.weight[i], s->W[i - 1]);
    pack(n, m, H, m, 1, w.sensor, J);
    for (long i = 0; i < n; i++) {
        memcpy(w.sensor + i * J + m, B + i * s->action, s->action * sizeof(real));
        memset(w.sensor + i * J + width, 0, (J - width) * sizeof(real));
    }
    if (s->information) {
        pack(m, n, H, 1, m, w.sensor_t, N);
        for (long i = 0; i < n; i++) w.inverse_noise[i] = 1 / noise[i];
        for (int k = 0; k < 2; k++) pack(m, m, cov[k], m, 1, w.prior[k], S); /* inverses, here */
        memset(w.by_prior[1], 0, m * S * sizeof(real));
        memset(g_noise, 0, n * sizeof(real));
    } else for (int k = 0; k < 2; k++) {
        memset(w.cross[k], 0, m * N * sizeof(real));
        memset(w.cov[k], 0, n * N * sizeof(real));
    }
    memset(w.carry, 0, batch * S * sizeof(real));
    memset(w.half, 0, s->groups * BYTES);
    memset(w.sum, 0, s->entries * BYTES);
    memset(g_initial, 0, m * sizeof(real));

    for (long t = time - 1; t >= 0; t--) {
        long row = t * batch;
        real *g = w.filtered + row * S, *u = w.left + row * N, *ge = w.error + row * N;
        real *top = w.layer[last] + row * S;
        for (long b = 0; b < batch; b++) {
            const real *outer = g_mean ? g_mean + (b * time + t) * m : 0;
            for (long i = 0; i < S; i++)
                g[b * S + i] = w.carry[b * S + i] + (outer && i < m ? outer[i] : 0);
        }
        /* ge, by the innovation: A^-1 (P H')' g through the gain, -g_ll z from the likelihood */
        if (s->information) { /* the same as W H C g */
            solve(s, t, tape.inverse, g, w.lanes, w.gained);
            product(batch, N, m, w.gained + row * S, S, 1, w.sensor_t, N, ge, N, 1, 0);
            for (long b = 0; b < batch; b++)
                for (long i = 0; i < n; i++)
                    ge[b * N + i] *= observed[(b * time + t) * n + i] ? w.inverse_noise[i] : 0;
        } else {
            for (long b = 0; b < batch;) {
                long first = b, k = reset[b * time + t] != 0;
                while (b < batch && (reset[b * time + t] != 0) == k) b++;
                product(b - first, N, m, g + first * S, S, 1, tape.cross[k], N, u + first * N, N, 1,
                        0);
            }
            solve(s, t, tape.inverse, u, w.lanes, w.error);
        }
        memset(w.by_predicted, 0, batch * J * sizeof(real));
        for (long b = 0; b < batch; b++) {
            long at = b * time + t, again = reset[at] != 0;
            real by = g_ll ? g_ll[at] : 0, half = (real)0.5 * by;
            real *e = ge + b * N, *left = u + b * N, *zb = tape.z + (row + b) * N;
            for (long i = n; i < N; i++) e[i] = 0;
            for (long i = 0; i < n; i++) e[i] -= by * zb[i];
            /* by A: (left z' + z left')/2 - half A^-1, summed over ordinary steps after the loop */
            for (long i = 0; i < N; i++) left[i] = -(e[i] + half * zb[i]);
            if (s->information) {
                by_information(s, &w, &tape, row + b, observed + at * n, half, again, g_noise);
            } else if (again) {
                const real *inverse = tape.inverse + (row + b) / LANES * n * n * LANES;
                add_outer(n, n, left, zb, w.cov[1], N);
                for (long i = 0; i < n * n; i++)
                    w.cov[1][i / n * N + i % n] -= half * inverse[i * LANES + (row + b) % LANES];
                add_outer(m, n, g + b * S, zb, w.cross[1], N);
                memset(left, 0, N * sizeof(real));
            } else {
                w.half[row + b] = half;
            }
            memcpy(w.by_predicted + b * J, g + b * S, m * sizeof(real));
            if (again) memset(g + b * S, 0, S * sizeof(real));
        }
        long from = s->information ? m / LANES * LANES : 0; /* it needs the action's columns only */
        product(batch, J - from, n, ge, N, 1, w.sensor + from, J, w.by_predicted + from, J, -1, 1);
        if (s->information) predicted_information(s, &w, &tape, t, reset, g_ll);
        for (long b = 0; b < batch; b++) {
            real *by = w.by_predicted + b * J;
            int again = reset[b * time + t] != 0;
            for (long i = 0; i < S; i++) top[b * S + i] = i < m && !again ? by[i] : 0;
            if (again) for (long i = 0; i < m; i++) g_initial[i] += by[i];
        }
        for (long i = last; i > 1; i--) {
            long wide = s->W[i - 1];
            real *to = w.layer[i - 1] + row * wide, *h = tape.hidden[i - 1] + row * wide;
            product(batch, wide, s->width[i], w.layer[i] + row * s->W[i], s->W[i], 1, w.weight[i],
                    wide, to, wide, 1, 0);
            if (s->relu) for (long k = 0; k < batch * wide; k++) to[k] = h[k] <= 0 ? 0 : to[k];
            else for (long k = 0; k < batch * wide; k++) to[k] *= 1 - h[k] * h[k];
        }
        product(batch, J, s->width[1], w.layer[1] + row * s->W[1], s->W[1], 1, w.weight[1], J,
                w.by_input, J, 1, 0);
        for (long b = 0; b < batch; b++) {
            long at = b * time + t;
            real *by = w.by_input + b * J, *carry = w.carry + b * S;
            if (s->residual) for (long i = 0; i < m; i++) by[i] += top[b * S + i];
            int again = restart && restart[at];
            for (long i = 0; i < m; i++) carry[i] = again ? 0 : by[i];
            if (g_stored)
                for (long i = 0; i < m; i++) g_stored[at * m + i] = again ? by[i] : 0;
            if (g_action)
                for (long i = 0; i < s->action; i++)
                    g_action[at * s->action + i] = by[m + i] + w.by_predicted[b * J + m + i];
            if (g_x) memcpy(g_x + at * n, ge + b * N, n * sizeof(real));
        }
    }
    if (g_start) unpack(batch, m, w.carry, S, g_start);

    for (long i = 1; i <= last; i++) {
        const real *in = i == 1 ? tape.input : tape.hidden[i - 1];
        real *by_weight = p[22 + last + 2 * i - 1], *by_bias = p[22 + last + 2 * i];
        long wide = s->W[i - 1];
        product(s->width[i], wide, s->rows, w.layer[i], 1, s->W[i], in, wide, w.wide, wide, 1, 0);
        unpack(s->width[i], s->width[i - 1], w.wide, wide, by_weight);
        memset(by_bias, 0, s->width[i] * sizeof(real));
        for (long r = 0; r < s->rows; r++)
            for (long k = 0; k < s->width[i]; k++) by_bias[k] += w.layer[i][r * s->W[i] + k];
    }
    product(n, J, s->rows, w.error, 1, N, tape.predicted, J, w.wide, J, -1, 0);
    unpack(n, m, w.wide, J, g_H);
    for (long i = 0; i < n; i++)
        memcpy(g_B + i * s->action, w.wide + i * J + m, s->action * sizeof(real));
    memset(g_d, 0, n * sizeof(real));
    for (long r = 0; r < s->rows; r++)
        for (long i = 0; i < n; i++) g_d[i] -= w.error[r * N + i];

    vec *sum = (vec *)w.sum;
    for (long g = 0; g < s->groups; g++) {
        vec half = *(vec *)(w.half + g * LANES);
        const vec *I = (const vec *)tape.inverse + g * s->entries;
        for (long i = 0; i < s->entries; i++) sum[i] += half * I[i];
    }
    if (s->information) {
        finish_information(s, &w, &tape, H, g_ll, observed, g_cov, g_noise, g_H);
        return;
    }

    product(m, N, s->rows, w.filtered, 1, S, tape.z, N, w.cross[0], N, 1, 0);
    product(n, N, s->rows, w.left, 1, N, tape.z, N, w.cov[0], N, 1, 0);
    for (long i = 0; i < n; i++)
        for (long j = 0; j < n; j++) {
            real total = 0;
            for (long l = 0; l < LANES; l++) total += sum[i * n + j][l];
            w.cov[0][i * N + j] -= total;
        }

    /* A = H C + R with C = P H': on to R, C, H and P */
    memset(g_noise, 0, (s->full_noise ? n * n : n) * sizeof(real));
    pack(n, m, H, m, 1, w.sensor, S); /* J is at least S */
    for (int k = 0; k < 2; k++) {
        for (long i = 0; i < n; i++)
            for (long j = 0; j < N; j++)
                w.square[i * N + j] =
                    j < n ? (real)0.5 * (w.cov[k][i * N + j] + w.cov[k][j * N + i]) : 0;
        for (long i = 0; i < n; i++) {
            if (!s->full_noise) g_noise[i] += w.square[i * N + i];
            else for (long j = 0; j < n; j++) g_noise[i * n + j] += w.square[i * N + j];
        }
        product(m, N, n, H, 1, m, w.square, N, w.cross[k], N, 1, 1);
        product(m, S, n, w.cross[k], N, 1, w.sensor, S, w.wide, S, 1, 0);
        unpack(m, m, w.wide, S, g_cov[k]);
        pack(m, m, cov[k], m, 1, w.noise_prior[k], S);
        product(n, S, n, w.square, N, 1, tape.cross_t[k], S, w.wide, S, 1, 0);
        product(n, S, m, w.cross[k], 1, N, w.noise_prior[k], S, w.wide, S, 1, 1);
        for (long i = 0; i < n; i++)
            for (long j = 0; j < m; j++) g_H[i * m + j] += w.wide[i * S + j];
    }
}
