/* What RunningMoments does at every step of every environment: statistics.py's masked_moments,
 * merge_moments and variance, then (x - mean) / sqrt(var + eps), in float64. Scaling is rounded as
 * PyTorch rounds it (this file is compiled without contraction); the sums have an order of their
 * own. running.py calls it; x is [rows, n], all else [n].
 */
#include <math.h>
#include <stdint.h>

#ifndef REAL
#define REAL float
#endif
typedef REAL real;

/* Either mask may be absent: `observed` for entries, `row` for whole rows. */
static inline int counts(const uint8_t *observed, const uint8_t *row, long r, long i) {
    return (!observed || observed[i]) && (!row || row[r]);
}

/* Merge what counts of a batch into count, mean and m2, in two passes over it; out: the new three
 * and the scale, at first the batch's own. 0: something that counts is not finite. */
int moments_learn(long rows, long n, double eps, const real *x, const uint8_t *observed,
                  const uint8_t *row, const double *count, const double *mean, const double *m2,
                  double *out_count, double *out_mean, double *out_m2, double *inverse_scale) {
    double all = 0;
    for (long j = 0; j < n; j++) out_count[j] = out_mean[j] = out_m2[j] = 0;
    for (long r = 0; r < rows; r++)
        for (long j = 0; j < n; j++) {
            long i = r * n + j;
            int counted = counts(observed, row, r, i);
            out_count[j] += counted;
            out_mean[j] += counted ? (double)x[i] : 0.0;
        }
    for (long j = 0; j < n; j++) out_mean[j] /= out_count[j] < 1 ? 1 : out_count[j];
    for (long r = 0; r < rows; r++)
        for (long j = 0; j < n; j++) {
            long i = r * n + j;
            double d = counts(observed, row, r, i) ? (double)x[i] - out_mean[j] : 0.0;
            out_m2[j] += d * d;
        }
    for (long j = 0; j < n; j++) all += out_m2[j];
    if (!isfinite(all)) return 0;
    for (long j = 0; j < n; j++) {
        double added = out_count[j], total = count[j] + added, delta = out_mean[j] - mean[j];
        double shift = added / (total < 1 ? 1 : total) * delta;
        out_count[j] = total;
        out_mean[j] = mean[j] + shift;
        out_m2[j] += m2[j] + delta * count[j] * shift;
        inverse_scale[j] = 1.0 / sqrt((total < 2 ? 1.0 : out_m2[j] / total) + eps);
    }
    return 1;
}

/* clip((x - mean) inverse_scale), 0 where not observed. Absent: mean is 0, all is observed. */
void moments_scale(long rows, long n, double clip, const real *x, const uint8_t *observed,
                   const double *mean, const double *inverse_scale, real *out) {
    for (long r = 0; r < rows; r++)
        for (long j = 0; j < n; j++) {
            long i = r * n + j;
            double v = ((double)x[i] - (mean ? mean[j] : 0.0)) * inverse_scale[j];
            v = v < -clip ? -clip : v; /* NaN stays */
            v = v > clip ? clip : v;
            out[i] = observed && !observed[i] ? (real)0 : (real)v;
        }
}
