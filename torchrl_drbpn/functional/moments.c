/* What RunningMoments does at every step of every environment, between the sums that PyTorch makes:
 * statistics.py's masked_moments, merge_moments and variance, then (x - mean) / sqrt(var + eps).
 * Every operation is rounded as PyTorch rounds it (this file is compiled without contraction), so
 * that both forms give the same bits. running.py calls it; x is [rows, n], all else [n].
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

/* What counts, 0 elsewhere; how much of it there is. */
void moments_fill(long rows, long n, const real *x, const uint8_t *observed, const uint8_t *row,
                  double *filled, double *count) {
    for (long j = 0; j < n; j++) count[j] = 0;
    for (long r = 0; r < rows; r++)
        for (long j = 0; j < n; j++) {
            long i = r * n + j;
            int counted = counts(observed, row, r, i);
            filled[i] = counted ? (double)x[i] : 0.0;
            count[j] += counted;
        }
}

/* The batch's mean from its sum, in place; the squared deviations in the place of the values. */
void moments_deviate(long rows, long n, const uint8_t *observed, const uint8_t *row,
                     const double *count, double *mean, double *filled) {
    for (long j = 0; j < n; j++) mean[j] /= count[j] < 1 ? 1 : count[j];
    for (long r = 0; r < rows; r++)
        for (long j = 0; j < n; j++) {
            long i = r * n + j;
            double d = counts(observed, row, r, i) ? filled[i] - mean[j] : 0.0;
            filled[i] = d * d;
        }
}

/* Merge a batch into count, mean, m2; out: the new three and the scale. 0: something not finite.
 * Without counts of its own the batch has `rows` samples of everything and variances, no sums. */
int moments_merge(long rows, long n, double eps, const double *count, const double *mean,
                  const double *m2, const double *batch_count, const double *batch_mean,
                  const double *spread, double *out) {
    double all = 0, factor = batch_count ? 1 : rows;
    for (long j = 0; j < n; j++) all += spread[j] * factor;
    if (!isfinite(all)) return 0;
    for (long j = 0; j < n; j++) {
        double added = batch_count ? batch_count[j] : rows, batch_m2 = spread[j] * factor;
        double total = count[j] + added, delta = batch_mean[j] - mean[j];
        double shift = added / (total < 1 ? 1 : total) * delta;
#ifdef __FMA__ /* as PyTorch's addcmul where the processor has it */
        double sum = fma(delta * count[j], shift, batch_m2 + m2[j]);
#else
        double sum = (batch_m2 + m2[j]) + delta * count[j] * shift;
#endif
        out[j] = total;
        out[n + j] = shift + mean[j];
        out[2 * n + j] = sum;
        out[3 * n + j] = 1.0 / sqrt((total < 2 ? 1.0 : sum / total) + eps);
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
