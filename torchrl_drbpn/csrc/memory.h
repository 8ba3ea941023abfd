/* How large everything is, and where it lies in the memory that the caller gives: the tape, which
 * forward writes and backward reads, and a scratch for each of the two.
 *
 * Row r = t * batch + b is step t of sequence b. Capitals are padded sizes: N, S, J of obs, state,
 * state + action.
 */
#define MAX_LAYERS 16

typedef struct {
    long batch, time, obs, state, action, layers, residual, relu, full_noise, start_stride,
        information, propagated;
    long width[MAX_LAYERS + 1], W[MAX_LAYERS + 1]; /* of layer outputs; 0: (state, action) */
    long N, S, J, rows, groups, half; /* half: entries of a lower triangle, state x state */
    long entries;                     /* kept of an inverse */
} Sizes;

static Sizes read_sizes(const int64_t *d) {
    Sizes z = {d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8], d[9], d[10], d[11]};
    z.width[0] = z.state + z.action;
    for (long i = 1; i <= z.layers; i++) z.width[i] = d[11 + i];
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
    real *input, *predicted, *hidden[MAX_LAYERS], *z, *inverse, *cross[2], *cross_t[2], *shift,
        *prior, *lifted;
} Tape;

static Tape lay_tape(const Sizes *s, Memory *m) {
    Tape t;
    t.input = take(m, s->rows * s->J), t.predicted = take(m, s->rows * s->J);
    for (long i = 1; i < s->layers; i++) t.hidden[i] = take(m, s->rows * s->W[i]);
    t.z = take(m, s->rows * s->N);
    t.inverse = take(m, s->groups * s->entries * LANES);
    if (s->propagated) {
        t.prior = take(m, s->groups * s->half * LANES);
        t.lifted = take(m, s->rows * s->S);
    }
    if (s->information) t.shift = take(m, s->rows * s->S);
    else for (int k = 0; k < 2; k++) {
        t.cross[k] = take(m, s->state * s->N);
        t.cross_t[k] = take(m, s->obs * s->S);
    }
    return t;
}

typedef struct { /* scratch of forward */
    real *weight_t[MAX_LAYERS + 1], *bias[MAX_LAYERS + 1], *sensor_t, *offset, *cov[2], *factor,
        *lower, *error, *error_lanes, *log_det, *mean, *step, *sensor, *inverse_noise, *log_noise,
        *products, *weight, *gathered, *square, *pull, *fit, *prior[2], *jacobian, *sigma, *before,
        *moved, *kept;
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
    } else a.cov[0] = take(m, s->obs * s->N), a.cov[1] = take(m, s->obs * s->N);
    if (s->propagated) {
        a.jacobian = take(m, n * n);
        a.sigma = take(m, (s->batch + LANES - 1) / LANES * s->half * LANES);
        a.before = take(m, n * n * LANES), a.moved = take(m, n * n * LANES);
        a.kept = take(m, s->half * LANES);
    }
    a.prior[0] = take(m, s->state * s->S), a.prior[1] = take(m, s->state * s->S);
    a.factor = take(m, n * n * LANES), a.lower = take(m, n * n * LANES);
    a.error = take(m, s->batch * s->N), a.error_lanes = take(m, n * LANES);
    a.log_det = take(m, s->groups * LANES);
    a.mean = take(m, s->batch * s->S), a.step = take(m, s->batch * s->S);
    return a;
}

/* Of `spread` in information.h: blocks of weights, one block of inverses, sums of half an
 * inverse a sensor. */
static long spread_size(const Sizes *s) {
    long sensors = (s->obs + BLOCK - 1) / BLOCK * BLOCK;
    return (sensors + BLOCK) * s->groups * LANES + s->obs * s->half;
}

typedef struct { /* scratch of backward */
    real *weight[MAX_LAYERS + 1], *layer[MAX_LAYERS + 1], *sensor, *noise_prior[2], *filtered,
        *error, *left, *half, *lanes, *sum, *carry, *by_predicted, *by_input, *cross[2], *cov[2],
        *square, *wide, *sensor_t, *inverse_noise, *gained, *prior[2],
        *by_prior[2], *outer, *full[2], *sum_first, *pull, *step, *spread, *g_noise, *g_H, *g_initial;
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
    if (s->propagated) {
        b.full[0] = take(m, s->state * s->state * LANES);
        b.full[1] = take(m, s->state * s->state * LANES);
        b.sum_first = take(m, s->half * LANES);
    }
    b.wide = take(m, widest * widest);
    b.g_noise = take(m, s->full_noise ? s->obs * s->obs : s->obs);
    b.g_H = take(m, s->obs * s->state), b.g_initial = take(m, s->state);
    return b;
}
