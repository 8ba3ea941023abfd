/* What goes missing, as corruption.py's missing_probability, sample_observed and the filling with
 * zeros have it, in one pass over [rows, n]: P(missing) = min(sigmoid(b + W x + V a), eta).
 * arrivals.py calls it. `weight` is absent under MCAR, `action` at the first step of an episode.
 */
#include <math.h>
#include <stdint.h>

#ifndef REAL
#define REAL float
#endif
typedef REAL real;

static inline real probability(long n, long actions, const real *x, const uint8_t *observed,
                               const real *action, const real *weight, const real *by_action,
                               real logit, real eta) {
    for (long j = 0; j < n; j++) /* what an earlier mask hides may be NaN: it enters no law */
        logit += weight[j] * (!observed || observed[j] ? x[j] : 0);
    if (action)
        for (long j = 0; j < actions; j++) logit += by_action[j] * action[j];
    real p = 1 / (1 + (real)exp(-logit));
    return p > eta ? eta : p; /* NaN stays: the entry arrives, and shows that something broke */
}

void arrivals_draw(long rows, long n, long actions, double eta, const real *x,
                   const uint8_t *observed, const real *action, const real *weight,
                   const real *bias, const real *by_action, const float *uniform,
                   uint8_t *arrived, real *filled) {
    for (long r = 0; r < rows; r++) {
        for (long i = 0; i < n; i++) {
            int here = !observed || observed[i];
            if (here && !weight) here = !(uniform[i] < (float)eta);
            else if (here && bias[i] != -INFINITY) /* those always arrive */
                here = !(uniform[i] < probability(n, actions, x, observed, action, weight + i * n,
                                                  by_action + i * actions, bias[i], eta));
            arrived[i] = here;
            filled[i] = here ? x[i] : 0;
        }
        x += n, uniform += n, arrived += n, filled += n;
        if (observed) observed += n;
        if (action) action += actions;
    }
}
