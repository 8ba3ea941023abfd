/* Vectors, matrix products and many small factorisations at once; nothing here knows of the filter.
 *
 * Every row of a matrix is padded with zeros to whole vectors, so that a product is made of whole
 * ones. Small matrices that differ from row to row are handled LANES at a time: entry (i, j) of
 * LANES matrices is one vector, so that the textbook loops are the vectorised ones.
 */
#if defined(__AVX512F__) /* a vector of the processor; wider ones would lie in memory */
#define BYTES 64
#elif defined(__AVX__)
#define BYTES 32
#else
#define BYTES 16
#endif
#define LANES ((long)(BYTES / sizeof(real)))
#define BLOCK 4
typedef real vec __attribute__((vector_size(BYTES), aligned(sizeof(real)), may_alias));
#define INLINE static inline __attribute__((always_inline))

INLINE long padded(long n) { return (n + LANES - 1) / LANES * LANES; }

INLINE real over_lanes(vec v) {
    real sum = 0;
    for (long l = 0; l < LANES; l++) sum += v[l];
    return sum;
}

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

/* C (+)= A B[k] row by row, k = 1 where `again` says so, else 0; `again` holds a flag every `stride`
 * bytes, one for each row of A. */
static void product_of_two(long rows, const uint8_t *again, long stride, long n, long inner,
                           const real *A, long lda, real *const B[2], real *C, long ldc, int add) {
    for (long r = 0; r < rows;) {
        long first = r, k = again[r * stride] != 0;
        while (r < rows && (again[r * stride] != 0) == k) r++;
        product(r - first, n, inner, A + first * lda, lda, 1, B[k], ldc, C + first * ldc, ldc, 1,
                add);
    }
}

static void add_outer(long rows, long cols, const real *left, const real *right, real *to, long ld) {
    for (long i = 0; i < rows; i++)
        for (long j = 0; j < cols; j++) to[i * ld + j] += left[i] * right[j];
}

/* to[r][c] = from[r * row + c * col], columns from `cols` to `ld` zero. */
#define PACK(name, type)                                                                        \
    static void name(long rows, long cols, const type *from, long row, long col, real *to,      \
                     long ld) {                                                                 \
        for (long r = 0; r < rows; r++) {                                                       \
            for (long c = 0; c < cols; c++) to[r * ld + c] = from[r * row + c * col];           \
            for (long c = cols; c < ld; c++) to[r * ld + c] = 0;                                \
        }                                                                                       \
    }
PACK(pack, real)
PACK(take_in, given)

static void widen(long n, const given *from, real *to) {
    for (long i = 0; i < n; i++) to[i] = from[i];
}

static void narrow(long n, const real *from, given *to) {
    for (long i = 0; i < n; i++) to[i] = (given)from[i];
}

static void give_out(long rows, long cols, const real *from, long ld, given *to) {
    for (long r = 0; r < rows; r++) narrow(cols, from + r * ld, to + r * cols);
}

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
        for (long l = 0; l < LANES; l++) c[l] = sqrt(c[l]);
        for (long l = 0; l < LANES; l++) sum[l] += 2 * log(c[l]);
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

/* out[r] = inverse_r in[r] for rows first .. last; `in` starts at row `first`, `out` at row 0. Of
 * the inverses, LANES to a group, there is all, or the lower triangle, one row after the other. */
static void solve(int triangle, long n, long ld, long first, long last, const real *inverse,
                  const real *in, real *lanes, real *out) {
    long entries = triangle ? n * (n + 1) / 2 : n * n;
    vec *e = (vec *)lanes;
    for (long group = first / LANES; group * LANES < last; group++) {
        long low = group * LANES > first ? group * LANES : first;
        long high = (group + 1) * LANES < last ? (group + 1) * LANES : last;
        if (high - low < LANES) memset(lanes, 0, n * BYTES);
        for (long r = low; r < high; r++)
            for (long i = 0; i < n; i++) lanes[i * LANES + r % LANES] = in[(r - first) * ld + i];
        const vec *I = (const vec *)inverse + group * entries;
        for (long i = 0; i < n; i++) {
            vec c = {0}, c2 = {0};
            if (triangle) {
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
