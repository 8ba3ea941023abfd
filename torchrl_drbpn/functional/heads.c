/* PPO's clipped gain and value error of two tanh networks that read the same features, and their
 * gradients: what objectives/_clipped.py computes in some fifty operations of PyTorch, each of which
 * costs more than its share of the arithmetic. heads.py calls it, compiled.py compiles it, once for
 * each `given`; sums over the batch are double, all else is of the caller's type, as in PyTorch.
 *
 * Head 0 is the policy's location, head 1 the value. A matrix has a row for each frame, padded with
 * zeros to whole vectors.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef REAL
#define REAL float
#endif
typedef REAL given;
typedef REAL real;
#define LOG_2PI 1.8378770664093453
#define MAX_LAYERS 8

#include "native_linalg.h"

typedef struct {
    long rows, columns, actions, kind, features; /* columns: of the effective sample sizes */
    long layers[2], width[2][MAX_LAYERS + 1], W[2][MAX_LAYERS + 1];
} Sizes;

static Sizes read_sizes(const int64_t *d) {
    Sizes z = {d[0], d[1], d[2], d[3], d[4], {d[5], d[6]}};
    const int64_t *width = d + 7;
    for (int h = 0; h < 2; h++) {
        z.width[h][0] = z.features;
        for (long i = 1; i <= z.layers[h]; i++) z.width[h][i] = *width++;
        for (long i = 0; i <= z.layers[h]; i++) z.W[h][i] = padded(z.width[h][i]);
    }
    return z;
}

typedef struct { real *base; long used; } Memory;

static real *take(Memory *m, long count) {
    long at = m->used;
    m->used += padded(count);
    return m->base ? m->base + at : 0;
}

typedef struct { /* what backward reads: inputs of every layer, gradients by outputs and by scale */
    real *input[2][MAX_LAYERS + 1], *by_scale;
} Tape;

static Tape lay_tape(const Sizes *s, Memory *m) {
    Tape t;
    t.input[0][0] = t.input[1][0] = take(m, s->rows * s->W[0][0]);
    for (int h = 0; h < 2; h++)
        for (long i = 1; i <= s->layers[h]; i++) t.input[h][i] = take(m, s->rows * s->W[h][i]);
    t.by_scale = take(m, s->actions);
    return t;
}

/* Scratch: of forward a transposed weight and a bias, of backward a weight and its gradient, and two
 * gradients by layers. */
typedef struct { real *weight, *other, *row, *by_layer[2]; } Scratch;

static Scratch lay_scratch(const Sizes *s, Memory *m) {
    Scratch w;
    long widest = 0;
    for (int h = 0; h < 2; h++)
        for (long i = 0; i <= s->layers[h]; i++) widest = s->W[h][i] > widest ? s->W[h][i] : widest;
    w.weight = take(m, widest * widest), w.other = take(m, widest * widest);
    w.row = take(m, s->rows > widest ? s->rows : widest);
    for (int k = 0; k < 2; k++) w.by_layer[k] = take(m, s->rows * widest);
    return w;
}

/* Reals that the caller allocates: tape, scratch. */
void heads_sizes(const int64_t *dims, int64_t *out) {
    Sizes s = read_sizes(dims);
    Memory tape = {0}, scratch = {0};
    lay_tape(&s, &tape), lay_scratch(&s, &scratch);
    out[0] = tape.used, out[1] = scratch.used;
}

/* ---------------------------------------------------------------- tanh of a whole vector */

typedef __typeof__(__builtin_choose_expr(sizeof(real) == 4, (int32_t)0, (int64_t)0)) whole;
typedef whole wholes __attribute__((vector_size(BYTES), may_alias));
#define SINGLE (sizeof(real) == 4)

/* By e = exp(y) - 1, y = -2 |x|: of small x no digit is lost. y = k log 2 + r, then the series in r;
 * LOG2_HIGH has so few bits that its products with k are exact. */
INLINE vec tanh_of(vec x) {
    const real LOG2_HIGH = 0x1.62e4p-1, LOG2_LOW = 0x1.7f7d1cf79abcap-20;
    const wholes sign = (wholes){0} + (whole)((whole)1 << (8 * sizeof(real) - 1));
    vec y = 2 * (vec)((wholes)x | sign);
    wholes tiny = y < -60; /* there tanh is 1 to rounding; NaN is not less than anything */
    y = (vec)((~tiny & (wholes)y) | (tiny & (wholes)((vec){0} - 60)));
    vec scaled = y * (real)1.4426950408889634 - (real)0.5;
    wholes k = __builtin_convertvector(scaled, wholes); /* towards zero: rounded, as y <= 0 */
    vec steps = __builtin_convertvector(k, vec);
    vec power = (vec)((k + (SINGLE ? 127 : 1023)) << (SINGLE ? 23 : 52));
    vec r = y - steps * LOG2_HIGH - steps * LOG2_LOW, series = (vec){0} + 1;
#pragma GCC unroll 16
    for (int n = SINGLE ? 8 : 14; n > 1; n--) series = 1 + r * series * (real)(1.0 / n);
    vec e = power * (r * series) + (power - 1);
    return (vec)((wholes)(e / (e + 2)) ^ (sign & ~(wholes)x)); /* e <= 0: minus tanh |x| */
}

/* ---------------------------------------------------------------- forward */

/* Layers of one head, from tape.input[head][0] to its last. */
static void run_head(const Sizes *s, const Tape *tape, const Scratch *w, int head, void **layers) {
    for (long i = 1; i <= s->layers[head]; i++) {
        const real *weight = layers[2 * i - 2], *bias = layers[2 * i - 1];
        long in = s->width[head][i - 1], out = s->width[head][i], wide = s->W[head][i];
        real *to = tape->input[head][i];
        pack(in, out, weight, 1, in, w->weight, wide);
        pack(1, out, bias, 0, 1, w->row, wide);
        for (long r = 0; r < s->rows; r++) memcpy(to + r * wide, w->row, wide * sizeof(real));
        product(s->rows, wide, in, tape->input[head][i - 1], s->W[head][i - 1], 1, w->weight, wide,
                to, wide, 1, 1);
        if (i < s->layers[head])
            for (long k = 0; k < s->rows * wide; k += LANES)
                *(vec *)(to + k) = tanh_of(*(const vec *)(to + k));
    }
}

/* min(w A, clip(w) A) for w the ratio of the policy to the old one, eq. (7) [Schulman et al. 2017];
 * the locations become their gradients. */
static void clip_gain(const Sizes *s, const Tape *tape, const Scratch *w, void **p, double low,
                      double high, double scale_floor) {
    const real *action = p[1], *old = p[2], *advantage = p[3], *log_scale = p[5];
    real *objective = p[6], *metrics = p[8], *sample_size = p[9], *kept = w->row;
    long n = s->actions, wide = s->W[0][s->layers[0]];
    real *scale = w->weight, *loc = tape->input[0][s->layers[0]];
    double by_scale[n], gained = 0, outside = 0, moved = 0, sum = 0, constant = 0;
    real largest = -INFINITY;
    for (long j = 0; j < n; j++) {
        real value = exp(log_scale[j]);
        scale[j] = value < (real)scale_floor ? (real)scale_floor : value;
        constant -= log(scale[j]) + 0.5 * LOG_2PI;
        by_scale[j] = 0;
    }
    for (long r = 0; r < s->rows; r++, loc += wide) {
        double log_prob = constant;
        for (long j = 0; j < n; j++) {
            real z = (action[r * n + j] - loc[j]) / scale[j];
            log_prob -= 0.5 * z * z;
            loc[j] = z;
        }
        real log_ratio = log_prob - old[r];
        real clipped = log_ratio < (real)low ? low : log_ratio > (real)high ? high : log_ratio;
        real limit = exp(clipped); /* rounded as the ratio is: inside the bounds the two are equal */
        real ratio = exp(log_ratio), gain = ratio * advantage[r];
        limit *= advantage[r];
        /* d(w A) / d log w = w A; the clipped gain is the smaller one where its gradient is 0 */
        real by = gain > limit ? 0 : -gain / s->rows; /* NaN stays */
        gained += gain > limit ? limit : gain;
        for (long j = 0; j < n; j++) {
            real z = loc[j];
            loc[j] = by * z / scale[j];
            by_scale[j] += by * (z * z - 1);
        }
        outside += clipped != log_ratio, moved += log_ratio, sum += ratio;
        if (largest == largest && !(ratio <= largest)) largest = ratio; /* NaN stays */
        kept[r] = log_ratio;
    }
    /* by the logarithm: d scale / d log scale = scale, 0 where the floor holds it up */
    for (long j = 0; j < n; j++)
        tape->by_scale[j] = exp(log_scale[j]) < (real)scale_floor ? 0 : by_scale[j];
    *objective = -gained / s->rows;
    metrics[0] = outside / s->rows, metrics[1] = -moved / s->rows;
    metrics[2] = largest, metrics[3] = sum / s->rows;
    for (long c = 0; c < s->columns; c++) { /* of each column, as ClipPPOLoss has it */
        double total = 0, squares = 0, highest = -INFINITY;
        for (long r = c; r < s->rows; r += s->columns) highest = fmax(highest, kept[r]);
        for (long r = c; r < s->rows; r += s->columns) {
            double weight = exp(kept[r] - highest);
            total += weight, squares += weight * weight;
        }
        sample_size[c] = total * total / squares / (s->rows / s->columns);
    }
}

/* The mean distance of the value from its target; the values become its gradient. */
static void value_error(const Sizes *s, const Tape *tape, const real *target, real *error) {
    long wide = s->W[1][s->layers[1]];
    real *value = tape->input[1][s->layers[1]];
    double sum = 0;
    for (long r = 0; r < s->rows; r++, value += wide) {
        real d = *value - target[r], size = fabs(d), sign = (d > 0) - (d < 0);
        if (s->kind == 2 && d != d) sign = d; /* as PyTorch's distances: l1 alone forgets a NaN */
        int square = s->kind == 0 || (s->kind == 2 && size < 1); /* l2, l1, smooth l1 */
        sum += square ? (s->kind ? 0.5 : 1) * d * d : s->kind == 1 ? size : size - 0.5;
        *value = (square ? (s->kind ? d : 2 * d) : sign) / s->rows;
    }
    *error = sum / s->rows;
}

/* p: features, action, old log-probability, advantage, value target, log scale; objective, error,
 * metrics (clip fraction, KL, largest and mean ratio), sample sizes; tape, scratch; then weight and
 * bias of every layer. bounds: log of the clipping's, floor of the scale. */
void heads_forward(const int64_t *dims, const double *bounds, void **p) {
    Sizes z = read_sizes(dims), *s = &z;
    Memory kept = {p[10], 0}, scratch = {p[11], 0};
    Tape tape = lay_tape(s, &kept);
    Scratch w = lay_scratch(s, &scratch);
    pack(s->rows, s->features, p[0], s->features, 1, tape.input[0][0], s->W[0][0]);
    run_head(s, &tape, &w, 0, p + 12);
    clip_gain(s, &tape, &w, p, bounds[0], bounds[1], bounds[2]);
    run_head(s, &tape, &w, 1, p + 12 + 2 * s->layers[0]);
    value_error(s, &tape, p[4], p[7]);
}

/* Actions of a rollout, from head 0 alone: location + scale noise, and their log-probability.
 * p: features, noise, scale; location, action, log-probability; tape, scratch; the layers. */
void heads_act(const int64_t *dims, void **p) {
    Sizes z = read_sizes(dims), *s = &z;
    const real *noise = p[1], *scale = p[2];
    real *loc = p[3], *action = p[4], *log_prob = p[5];
    Memory kept = {p[6], 0}, scratch = {p[7], 0};
    Tape tape = lay_tape(s, &kept);
    Scratch w = lay_scratch(s, &scratch);
    long n = s->actions, wide = s->W[0][s->layers[0]];
    const real *out = tape.input[0][s->layers[0]];
    double constant = 0;
    for (long j = 0; j < n; j++) constant -= log(scale[j]) + 0.5 * LOG_2PI;
    pack(s->rows, s->features, p[0], s->features, 1, tape.input[0][0], s->W[0][0]);
    run_head(s, &tape, &w, 0, p + 8);
    for (long r = 0; r < s->rows; r++, out += wide) {
        double sum = constant;
        for (long j = 0; j < n; j++) {
            long at = r * n + j;
            loc[at] = out[j];
            action[at] = noise[at] * scale[j] + out[j];
            real z = (action[at] - out[j]) / scale[j]; /* what rounding left of the noise */
            sum -= 0.5 * z * z;
        }
        log_prob[r] = sum;
    }
}

/* ---------------------------------------------------------------- backward */

/* Gradients of one head; those by the features are added to what is there where `add` says so. */
static void head_back(const Sizes *s, const Tape *tape, const Scratch *w, int head, real by,
                      void **layers, void **g_layers, real *g_features, int add) {
    long last = s->layers[head];
    const real *top = tape->input[head][last];
    real *delta = w->by_layer[last % 2];
    for (long k = 0; k < s->rows * s->W[head][last]; k++) delta[k] = by * top[k];
    for (long i = last; i >= 1; i--) {
        const real *input = tape->input[head][i - 1];
        long in = s->width[head][i - 1], out = s->width[head][i];
        long W_in = s->W[head][i - 1], W_out = s->W[head][i];
        delta = w->by_layer[i % 2];
        product(out, W_in, s->rows, delta, 1, W_out, input, W_in, w->other, W_in, 1, 0);
        for (long r = 0; r < out; r++)
            memcpy((real *)g_layers[2 * i - 2] + r * in, w->other + r * W_in, in * sizeof(real));
        memset(w->row, 0, W_out * sizeof(real));
        for (long r = 0; r < s->rows; r++)
            for (long k = 0; k < W_out; k++) w->row[k] += delta[r * W_out + k];
        memcpy(g_layers[2 * i - 1], w->row, out * sizeof(real));
        if (i == 1 && !g_features) continue;
        pack(out, in, layers[2 * i - 2], in, 1, w->weight, W_in);
        real *below = w->by_layer[(i - 1) % 2];
        product(s->rows, W_in, out, delta, W_out, 1, w->weight, W_in, below, W_in, 1, 0);
        if (i > 1) {
            for (long k = 0; k < s->rows * W_in; k++) below[k] *= 1 - input[k] * input[k];
            continue;
        }
        for (long r = 0; r < s->rows; r++)
            for (long k = 0; k < in; k++) {
                real *to = g_features + r * in + k;
                *to = below[r * W_in + k] + (add ? *to : 0);
            }
    }
}

/* p: gradients by objective and by error, tape, scratch; out: gradients by features (may be absent)
 * and by log scale; then weight and bias of every layer, then their gradients. Where one of the first
 * two is absent, nothing of its head is computed or written. */
void heads_backward(const int64_t *dims, void **p) {
    Sizes z = read_sizes(dims), *s = &z;
    const real *by[2] = {p[0], p[1]};
    Memory kept = {p[2], 0}, scratch = {p[3], 0};
    Tape tape = lay_tape(s, &kept);
    Scratch w = lay_scratch(s, &scratch);
    real *g_scale = p[5];
    void **layers = p + 6, **g_layers = layers + 2 * (s->layers[0] + s->layers[1]);
    for (long j = 0; by[0] && j < s->actions; j++) g_scale[j] = *by[0] * tape.by_scale[j];
    for (int h = 0, add = 0; h < 2; h++) {
        if (!by[h]) continue;
        head_back(s, &tape, &w, h, *by[h], layers + 2 * h * s->layers[0],
                  g_layers + 2 * h * s->layers[0], p[4], add);
        add = 1;
    }
}
