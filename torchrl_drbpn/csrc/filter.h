/* The belief filter over [batch, time] and its reverse pass as two functions, for a constant Q, eq.
 * (8), (10), (12) [DRBPN]. The same sums as functional/pytorch_form.py, where PyTorch needs some
 * hundred small operations a minibatch. filter_float.c and filter_double.c compile it, once for each
 * `given`.
 *
 * The two forms, innovation.h and information.h, differ in how z = inv(S) e and the gain of a row
 * come about, and in what the covariances receive. What is here serves both: the transition, the
 * innovation e = y - H m - B a - d of the predicted mean, their gradients, and at the end those of
 * weights, biases, H, B and d.
 *
 * What the caller gives and gets is of type `given`, float or double; all arithmetic is in double. S
 * is as ill-conditioned as signal over noise, and where H is of low rank float loses most digits of
 * inv(S). Likelihoods, their gradients and the information form's inv(P) are double for every caller.
 *
 * Nothing is checked here: functional/native.py checks every size before it calls.
 */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double real;
#define LOG_2PI 1.8378770664093453

#include "linalg.h"
#include "memory.h"
#include "innovation.h"
#include "information.h"

/* Of what sizes, forward and backward are given, in number and order: raise it with them here and in
 * functional/native.py, which loads no library of another number. */
#define ABI 1
int64_t NAME(abi)(void) { return ABI; }

/* Reals that the caller allocates: tape, scratch of forward, scratch of backward. */
void NAME(sizes)(const int64_t *dims, int64_t *out) {
    Sizes s = read_sizes(dims);
    Memory tape = {0}, ahead = {0}, back = {0};
    lay_tape(&s, &tape), lay_ahead(&s, &ahead), lay_back(&s, &back);
    out[0] = tape.used, out[1] = ahead.used, out[2] = back.used;
}

/* One step of the transition: the predicted mean into a.mean and, beside the action, predicted. */
static void predict(const Sizes *s, const Ahead *a, const Tape *tape, long t, const given *start,
                    const given *stored, const uint8_t *use_stored, const given *action,
                    const uint8_t *reset, const given *initial) {
    long m = s->state, width = s->width[0], S = s->S, J = s->J;
    long batch = s->batch, time = s->time, row = t * batch;
    real *input = tape->input + row * J, *predicted = tape->predicted + row * J;
    for (long b = 0; b < batch; b++) {
        /* An episode start must not hear of what came before, not even of a NaN. */
        if (reset[b * time + t]) memset(input + b * J, 0, m * sizeof(real));
        else if (use_stored && use_stored[b * time + t])
            widen(m, stored + (b * time + t) * m, input + b * J);
        else if (t == 0) widen(m, start + b * s->start_stride, input + b * J);
        else memcpy(input + b * J, a->mean + b * S, m * sizeof(real));
        widen(s->action, action + (b * time + t) * s->action, input + b * J + m);
        memset(input + b * J + width, 0, (J - width) * sizeof(real));
        memcpy(predicted + b * J, input + b * J, J * sizeof(real));
    }
    const real *h = input;
    for (long i = 1; i <= s->layers; i++) {
        long wide = s->W[i];
        real *out = i < s->layers ? tape->hidden[i] + row * wide : a->step;
        for (long b = 0; b < batch; b++) memcpy(out + b * wide, a->bias[i], wide * sizeof(real));
        product(batch, wide, s->width[i - 1], h, s->W[i - 1], 1, a->weight_t[i], wide, out, wide, 1,
                1);
        if (i < s->layers) {
            if (s->relu) for (long k = 0; k < batch * wide; k++) out[k] = out[k] < 0 ? 0 : out[k];
            else for (long k = 0; k < batch * wide; k++) out[k] = tanh(out[k]);
        }
        h = out;
    }
    for (long b = 0; b < batch; b++) {
        real *to = predicted + b * J, *out = a->mean + b * S;
        for (long i = 0; i < m; i++) {
            real moved = a->step[b * S + i] + (s->residual ? input[b * J + i] : 0);
            to[i] = out[i] = reset[b * time + t] ? initial[i] : moved;
        }
    }
}

void NAME(forward)(const int64_t *dims, void **p) {
    Sizes z = read_sizes(dims), *s = &z;
    const given *x = p[0], *action = p[2], *stored = p[5], *start = p[6];
    const given *noise = p[9], *H = p[10], *B = p[11], *d = p[12], *initial = p[13];
    const uint8_t *observed = p[1], *reset = p[3], *use_stored = p[4];
    given *mean = p[14];
    real *ll = p[15];
    Memory kept = {p[16], 0}, scratch = {p[17], 0};
    Tape tape = lay_tape(s, &kept);
    Ahead a = lay_ahead(s, &scratch);
    long n = s->obs, m = s->state, width = s->width[0], N = s->N, J = s->J;
    long batch = s->batch, time = s->time;

    for (long i = 1; i <= s->layers; i++) {
        const given *weight = p[20 + 2 * i], *bias = p[21 + 2 * i];
        take_in(s->width[i - 1], s->width[i], weight, 1, s->width[i - 1], a.weight_t[i], s->W[i]);
        take_in(1, s->width[i], bias, 0, 1, a.bias[i], s->W[i]);
    }
    take_in(m, n, H, 1, m, a.sensor_t, N);
    take_in(s->action, n, B, 1, s->action, a.sensor_t + m * N, N);
    take_in(1, n, d, 0, 1, a.offset, N);
    if (s->information) prepare_information(s, &a, &tape, p + 7, noise, H, observed, reset, p);
    else prepare_innovation(s, &a, &tape, p + 7, noise, observed, reset);

    for (long t = 0; t < time; t++) {
        predict(s, &a, &tape, t, start, stored, use_stored, action, reset, initial);
        for (long b = 0; b < batch; b++) memcpy(a.error + b * N, a.offset, N * sizeof(real));
        product(batch, N, width, tape.predicted + t * batch * J, J, 1, a.sensor_t, N, a.error, N, 1,
                1);
        for (long b = 0; b < batch; b++) {
            long at = (b * time + t) * n;
            real *e = a.error + b * N;
            for (long i = 0; i < n; i++) e[i] = observed[at + i] ? x[at + i] - e[i] : 0;
        }
        if (s->information) gain_information(s, &a, &tape, t, observed, reset, mean, ll);
        else gain_innovation(s, &a, &tape, t, observed, reset, mean, ll);
    }
}

/* One step of the transition back, from w.layer[last] to w.by_input. */
static void by_transition(const Sizes *s, const Back *w, const Tape *tape, long t) {
    long m = s->state, S = s->S, J = s->J, batch = s->batch, row = t * batch, last = s->layers;
    const real *top = w->layer[last] + row * S;
    for (long i = last; i > 1; i--) {
        long wide = s->W[i - 1];
        real *to = w->layer[i - 1] + row * wide, *h = tape->hidden[i - 1] + row * wide;
        product(batch, wide, s->width[i], w->layer[i] + row * s->W[i], s->W[i], 1, w->weight[i],
                wide, to, wide, 1, 0);
        if (s->relu) for (long k = 0; k < batch * wide; k++) to[k] = h[k] <= 0 ? 0 : to[k];
        else for (long k = 0; k < batch * wide; k++) to[k] *= 1 - h[k] * h[k];
    }
    product(batch, J, s->width[1], w->layer[1] + row * s->W[1], s->W[1], 1, w->weight[1], J,
            w->by_input, J, 1, 0);
    if (s->residual)
        for (long b = 0; b < batch; b++)
            for (long i = 0; i < m; i++) w->by_input[b * J + i] += top[b * S + i];
}

void NAME(backward)(const int64_t *dims, void **p) {
    Sizes z = read_sizes(dims), *s = &z;
    const given *g_mean = p[0], *H = p[6], *B = p[7];
    const real *g_ll = p[1];
    const uint8_t *reset = p[2], *use_stored = p[3];
    Memory kept = {p[8], 0}, scratch = {p[9], 0};
    given *g_x = p[10], *g_action = p[11], *g_stored = p[12], *g_start = p[13], *g_B = p[18];
    const uint8_t *observed = p[21];
    const given *noise = p[22];
    Tape tape = lay_tape(s, &kept);
    Back w = lay_back(s, &scratch);
    long n = s->obs, m = s->state, width = s->width[0], N = s->N, S = s->S, J = s->J;
    long batch = s->batch, time = s->time, last = s->layers;

    for (long i = 1; i <= last; i++)
        take_in(s->width[i], s->width[i - 1], p[22 + i], s->width[i - 1], 1, w.weight[i],
                s->W[i - 1]);
    take_in(n, m, H, m, 1, w.sensor, J);
    for (long i = 0; i < n; i++) {
        widen(s->action, B + i * s->action, w.sensor + i * J + m);
        memset(w.sensor + i * J + width, 0, (J - width) * sizeof(real));
    }
    if (s->information) begin_information(s, &w, p + 4, noise, H);
    else begin_innovation(s, &w);
    memset(w.carry, 0, batch * S * sizeof(real));
    memset(w.half, 0, s->groups * BYTES);
    memset(w.sum, 0, s->entries * BYTES);
    memset(w.g_initial, 0, m * sizeof(real));

    for (long t = time - 1; t >= 0; t--) {
        long row = t * batch;
        real *g = w.filtered + row * S, *ge = w.error + row * N, *top = w.layer[last] + row * S;
        for (long b = 0; b < batch; b++) {
            const given *outer = g_mean ? g_mean + (b * time + t) * m : 0;
            for (long i = 0; i < S; i++)
                g[b * S + i] = w.carry[b * S + i] + (outer && i < m ? outer[i] : 0);
        }
        /* ge, by the innovation: through the gain, and -g_ll z from the likelihood */
        if (s->information) by_gain_information(s, &w, &tape, t, observed);
        else by_gain_innovation(s, &w, &tape, t, reset);
        memset(w.by_predicted, 0, batch * J * sizeof(real));
        for (long b = 0; b < batch; b++) {
            long at = b * time + t, again = reset[at] != 0;
            real by = g_ll ? g_ll[at] : 0, half = 0.5 * by;
            real *e = ge + b * N, *left = w.left + (row + b) * N, *zb = tape.z + (row + b) * N;
            for (long i = n; i < N; i++) e[i] = 0;
            for (long i = 0; i < n; i++) e[i] -= by * zb[i];
            /* by S: (left z' + z left')/2 - half inv(S), of ordinary steps summed after the loop */
            for (long i = 0; i < N; i++) left[i] = -(e[i] + half * zb[i]);
            if (s->information)
                by_information(s, &w, &tape, row + b, observed + at * n, half, again);
            else by_innovation(s, &w, &tape, row + b, half, again);
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
            if (again) for (long i = 0; i < m; i++) w.g_initial[i] += by[i];
        }
        by_transition(s, &w, &tape, t);
        for (long b = 0; b < batch; b++) {
            long at = b * time + t;
            real *by = w.by_input + b * J, *carry = w.carry + b * S;
            int again = use_stored && use_stored[at];
            for (long i = 0; i < m; i++) carry[i] = again ? 0 : by[i];
            if (g_stored)
                for (long i = 0; i < m; i++) g_stored[at * m + i] = again ? by[i] : 0;
            if (g_action)
                for (long i = 0; i < s->action; i++)
                    g_action[at * s->action + i] = by[m + i] + w.by_predicted[b * J + m + i];
            if (g_x) narrow(n, ge + b * N, g_x + at * n);
        }
    }
    if (g_start) give_out(batch, m, w.carry, S, g_start);

    for (long i = 1; i <= last; i++) {
        const real *in = i == 1 ? tape.input : tape.hidden[i - 1];
        long wide = s->W[i - 1];
        product(s->width[i], wide, s->rows, w.layer[i], 1, s->W[i], in, wide, w.wide, wide, 1, 0);
        give_out(s->width[i], s->width[i - 1], w.wide, wide, p[22 + last + 2 * i - 1]);
        memset(w.wide, 0, s->W[i] * sizeof(real));
        for (long r = 0; r < s->rows; r++)
            for (long k = 0; k < s->width[i]; k++) w.wide[k] += w.layer[i][r * s->W[i] + k];
        narrow(s->width[i], w.wide, p[22 + last + 2 * i]);
    }
    product(n, J, s->rows, w.error, 1, N, tape.predicted, J, w.wide, J, -1, 0);
    for (long i = 0; i < n; i++) {
        memcpy(w.g_H + i * m, w.wide + i * J, m * sizeof(real));
        narrow(s->action, w.wide + i * J + m, g_B + i * s->action);
    }
    memset(w.wide, 0, N * sizeof(real));
    for (long r = 0; r < s->rows; r++)
        for (long i = 0; i < n; i++) w.wide[i] -= w.error[r * N + i];
    narrow(n, w.wide, p[19]);

    vec *sum = (vec *)w.sum;
    for (long g = 0; g < s->groups && !s->propagated; g++) {
        vec half = *(vec *)(w.half + g * LANES);
        const vec *I = (const vec *)tape.inverse + g * s->entries;
        for (long i = 0; i < s->entries; i++) sum[i] += half * I[i];
    }
    if (s->information) finish_information(s, &w, &tape, H, g_ll, observed, reset, p + 14);
    else finish_innovation(s, &w, &tape, H, p + 4, p + 14);
    narrow(s->full_noise ? n * n : n, w.g_noise, p[16]);
    narrow(n * m, w.g_H, p[17]);
    narrow(m, w.g_initial, p[20]);
}
