/* See tipforce_judge.h. */
#include "tipforce_judge.h"

#include <math.h>
#include <string.h>

typedef TIPFORCE_REAL real;

#define N TIPFORCE_GAUGES
#define SMALLEST_PIVOT 1e-13
#define SMALLEST_VARIANCE 1e-6
#define CONDITION_LIMIT 1e4
#define NO_FAULT 16.0
#define LEAST_SHARE ((real)0.1)
#define RELEASE ((real)0.95)
#define UNSTATED_KELVIN 10.0

static double exceeds(double x, int degrees)
{
    double half = 0.5 * x, total, term;
    int k;
    if (degrees % 2) {
        total = erfc(sqrt(half)), term = sqrt(half / 3.14159265358979323846) * exp(-half) * 2.0, k = 3;
    } else {
        total = exp(-half), term = half * exp(-half), k = 4;
    }
    for (; k <= degrees; k += 2) {
        total += term;
        term *= x / k;
    }
    return total;
}

static double same_rate(double limit, int degrees, int fewer)
{
    double rate = exceeds(limit, degrees), low = 0.0, high = 1.0;
    if (!(rate > 0.0 && rate < 1.0)) {
        return limit;
    }
    while (exceeds(high, fewer) > rate) {
        low = high, high *= 2.0;
    }
    for (int k = 0; k < 200; k++) {
        double middle = 0.5 * (low + high);
        if (exceeds(middle, fewer) > rate) {
            low = middle;
        } else {
            high = middle;
        }
    }
    return high;
}

static int place(int i, int k) { return i <= k ? i * N - i * (i - 1) / 2 + k - i : place(k, i); }

/* X of M X = B, M n x n symmetric positive definite, B n x m; false where M is singular. Rows have the stride N + 3. */
static bool solved(int n, int m, double M[N][N], double B[N][N + 3])
{
    double scale[N], work[N][2 * N + 3];
    for (int i = 0; i < n; i++) {
        if (!(M[i][i] > 0.0)) {
            return false;
        }
        scale[i] = 1.0 / sqrt(M[i][i]);
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            work[i][j] = M[i][j] * scale[i] * scale[j];
        }
        for (int j = 0; j < m; j++) {
            work[i][n + j] = B[i][j] * scale[i];
        }
    }
    for (int i = 0; i < n; i++) {
        if (!(work[i][i] > SMALLEST_PIVOT)) {
            return false;
        }
        for (int k = i + 1; k < n; k++) {
            double factor = work[k][i] / work[i][i];
            for (int j = i; j < n + m; j++) {
                work[k][j] -= factor * work[i][j];
            }
        }
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int j = n; j < n + m; j++) {
            for (int k = i + 1; k < n; k++) {
                work[i][j] -= work[i][k] * work[k][j];
            }
            work[i][j] /= work[i][i];
        }
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < m; j++) {
            B[i][j] = work[i][n + j] * scale[i];
        }
    }
    return true;
}

/* A of V = A F + e: strain per newton. */
static bool structure(const tipforce_record *r, double A[N][3])
{
    double M[N][N] = {{0.0}}, B[N][N + 3] = {{0.0}};
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < N; k++) {
            for (int j = 0; j < N; j++) {
                B[i][k] += r->C[i][j] * r->noise[place(j, k)];
            }
        }
    }
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            for (int k = 0; k < N; k++) {
                M[i][j] += B[i][k] * r->C[j][k];
            }
        }
    }
    if (!solved(3, N, M, B)) {
        return false;
    }
    for (int k = 0; k < N; k++) {
        for (int i = 0; i < 3; i++) {
            A[k][i] = B[i][k];
        }
    }
    return true;
}

/* Condition number (2-norm) of 3 rows: one-sided Jacobi. */
static double condition(double rows[3][N])
{
    double work[3][N], largest = 0.0, smallest = HUGE_VAL;
    memcpy(work, rows, sizeof work);
    for (int sweep = 0; sweep < 30; sweep++) {
        for (int i = 0; i < 3; i++) {
            for (int k = i + 1; k < 3; k++) {
                double aa = 0.0, bb = 0.0, ab = 0.0;
                for (int j = 0; j < N; j++) {
                    aa += work[i][j] * work[i][j], bb += work[k][j] * work[k][j], ab += work[i][j] * work[k][j];
                }
                if (fabs(ab) <= 1e-15 * sqrt(aa * bb)) {
                    continue;
                }
                double zeta = (bb - aa) / (2.0 * ab);
                double t = (zeta >= 0.0 ? 1.0 : -1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                double c = 1.0 / sqrt(1.0 + t * t), s = c * t;
                for (int j = 0; j < N; j++) {
                    double x = work[i][j], y = work[k][j];
                    work[i][j] = c * x - s * y;
                    work[k][j] = s * x + c * y;
                }
            }
        }
    }
    for (int i = 0; i < 3; i++) {
        double length = 0.0;
        for (int j = 0; j < N; j++) {
            length += work[i][j] * work[i][j];
        }
        largest = fmax(largest, sqrt(length)), smallest = fmin(smallest, sqrt(length));
    }
    return smallest > 0.0 ? largest / smallest : HUGE_VAL;
}

static void propagate(const tipforce_record *r, double C[3][N], double cov[6])
{
    int at = 0;
    for (int a = 0; a < 3; a++) {
        for (int b = a; b < 3; b++, at++) {
            cov[at] = 0.0;
            for (int j = 0; j < N; j++) {
                for (int k = 0; k < N; k++) {
                    cov[at] += C[a][j] * r->noise[place(j, k)] * C[b][k];
                }
            }
        }
    }
}

/* C and cov of the gauges kept: weighted least squares with what is known of the noise. */
static bool leave_out(const tipforce_record *r, double A[N][3], const int kept[N], int m, double C[3][N])
{
    double S[N][N], B[N][N + 3], M[N][N] = {{0.0}}, X[N][N + 3];
    for (int i = 0; i < m; i++) {
        for (int j = 0; j < m; j++) {
            S[i][j] = r->noise[place(kept[i], kept[j])];
        }
        for (int j = 0; j < 3; j++) {
            B[i][j] = A[kept[i]][j];
        }
    }
    if (!solved(m, 3, S, B)) {
        return false;
    }
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            for (int k = 0; k < m; k++) {
                M[i][j] += A[kept[k]][i] * B[k][j];
            }
        }
        for (int k = 0; k < m; k++) {
            X[i][k] = B[k][i];
        }
    }
    if (!solved(3, m, M, X)) {
        return false;
    }
    memset(C, 0, 3 * sizeof C[0]);
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < m; k++) {
            C[i][kept[k]] = X[i][k];
        }
    }
    return condition(C) <= CONDITION_LIMIT;
}

/* Rows W with W A = 0 and W S W^T = 1, of the gauges kept; false where S or A is singular. */
static bool directions(const tipforce_record *r, double A[N][3], const int kept[N], int m, double W[N][N])
{
    double L[N][N] = {{0.0}}, inverse[N][N] = {{0.0}}, basis[N][N] = {{0.0}};
    int found = 0;
    for (int i = 0; i < m; i++) {
        for (int j = 0; j <= i; j++) {
            double total = r->noise[place(kept[i], kept[j])];
            for (int k = 0; k < j; k++) {
                total -= L[i][k] * L[j][k];
            }
            if (i == j && !(total > 1e-12 * r->noise[place(kept[i], kept[i])])) {
                return false;
            }
            L[i][j] = i == j ? sqrt(total) : total / L[j][j];
        }
    }
    for (int j = 0; j < m; j++) {
        for (int i = j; i < m; i++) {
            double total = i == j ? 1.0 : 0.0;
            for (int k = j; k < i; k++) {
                total -= L[i][k] * inverse[k][j];
            }
            inverse[i][j] = total / L[i][i];
        }
    }
    while (found < m) {
        double left[N] = {0.0}, length = 0.0;
        if (found < 3) {
            for (int i = 0; i < m; i++) {
                for (int k = 0; k <= i; k++) {
                    left[i] += inverse[i][k] * A[kept[k]][found];
                }
                length += left[i] * left[i];
            }
        } else { /* of the unit vectors the one that is furthest from what is spanned */
            int axis = 0;
            double most = -1.0;
            for (int i = 0; i < m; i++) {
                double rest = 1.0;
                for (int b = 0; b < found; b++) {
                    rest -= basis[b][i] * basis[b][i];
                }
                if (rest > most) {
                    most = rest, axis = i;
                }
            }
            left[axis] = length = 1.0;
        }
        if (!(length > 0.0)) {
            return false;
        }
        for (int i = 0; i < m; i++) {
            left[i] /= sqrt(length);
        }
        for (int b = 0; b < 2 * found; b++) {
            double along = 0.0;
            for (int i = 0; i < m; i++) {
                along += basis[b % found][i] * left[i];
            }
            for (int i = 0; i < m; i++) {
                left[i] -= along * basis[b % found][i];
            }
        }
        length = 0.0;
        for (int i = 0; i < m; i++) {
            length += left[i] * left[i];
        }
        if (!(length > 1e-12)) {
            return false;
        }
        for (int i = 0; i < m; i++) {
            basis[found][i] = left[i] / sqrt(length);
        }
        found++;
    }
    memset(W, 0, N * sizeof W[0]);
    for (int d = 3; d < m; d++) {
        for (int k = 0; k < m; k++) {
            for (int i = k; i < m; i++) {
                W[d - 3][kept[k]] += basis[d][i] * inverse[i][k];
            }
        }
    }
    return true;
}

static void set_subset(const tipforce_record *r, unsigned lost, tipforce_subset *s)
{
    double A[N][3], C[3][N], W[N][N], cov[6];
    tipforce_record weights = *r;
    int kept[N] = {0}, m = 0;
    bool noisy = false;
    memset(s, 0, sizeof *s);
    for (int k = 0; k < N; k++) {
        noisy = noisy || r->noise[place(k, k)] > 0.0;
        if (!(lost >> k & 1u)) {
            kept[m++] = k;
        }
    }
    for (int k = 0; k < N && !noisy; k++) { /* gauges of equal noise */
        weights.noise[place(k, k)] = 1.0;
    }
    memcpy(C, r->C, sizeof C);
    bool structured = N > 3 && structure(&weights, A);
    s->usable = !lost || (structured && m >= 3 && leave_out(&weights, A, kept, m, C));
    if (!s->usable) {
        return;
    }
    propagate(r, C, cov);
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < N; k++) {
            s->C[i][k] = (real)C[i][k];
        }
    }
    for (int i = 0; i < 6; i++) {
        s->cov[i] = (real)cov[i];
    }
    if (!structured || !noisy || m < 4 || !(r->redundancy_limit > 0.0) || !directions(r, A, kept, m, W)) {
        return;
    }
    s->rows = (uint8_t)(m - 3);
    s->alarm = (real)(m == N ? r->redundancy_limit : same_rate(r->redundancy_limit, N - 3, m - 3));
    s->exclusion = (real)(m > 4 ? same_rate(r->redundancy_limit, N - 3, m - 4) : 0.0);
    for (int k = 0; k < N; k++) {
        double length = 0.0;
        for (int d = 0; d < m - 3; d++) {
            s->W[d][k] = (real)W[d][k];
            length += W[d][k] * W[d][k];
        }
        if (length * r->noise[place(k, k)] >= SMALLEST_VARIANCE) {
            s->shown |= (uint8_t)(1u << k);
        }
    }
}

/* -1: the gauges agree; else the bits of those that may be at fault. explained and visible: of each gauge's fault. */
static int judged(const tipforce_subset *s, const real V[N], const real extra[N], real explained[N], real visible[N])
{
    real L[N][N] = {{0}}, q[N] = {0}, chi_square = 0;
    unsigned bits = 0;
    for (int i = 0; i < s->rows; i++) {
        real p = 0;
        for (int k = 0; k < N; k++) {
            p += s->W[i][k] * V[k];
        }
        for (int j = 0; j <= i; j++) {
            real total = i == j ? (real)1.0 : (real)0.0;
            for (int k = 0; k < N; k++) {
                total += s->W[i][k] * extra[k] * s->W[j][k];
            }
            for (int k = 0; k < j; k++) {
                total -= L[i][k] * L[j][k];
            }
            L[i][j] = i == j ? (real)sqrt((double)total) : total / L[j][j];
        }
        for (int k = 0; k < i; k++) {
            p -= L[i][k] * q[k];
        }
        q[i] = p / L[i][i];
        chi_square += q[i] * q[i];
    }
    for (int g = 0; g < N; g++) {
        real column[N], along = 0;
        explained[g] = visible[g] = 0;
        if (!(s->shown >> g & 1u)) {
            continue;
        }
        for (int i = 0; i < s->rows; i++) {
            column[i] = s->W[i][g];
            for (int k = 0; k < i; k++) {
                column[i] -= L[i][k] * column[k];
            }
            column[i] /= L[i][i];
            visible[g] += column[i] * column[i];
            along += column[i] * q[i];
        }
        explained[g] = along * along / visible[g];
        if (s->rows == 1 || chi_square - explained[g] <= s->exclusion) {
            bits |= 1u << g;
        }
    }
    if (chi_square <= s->alarm) {
        return -1;
    }
    return chi_square - chi_square == 0 ? (int)bits : 0;
}

static void add(real cov[6], const real f[3])
{
    cov[0] += f[0] * f[0], cov[1] += f[0] * f[1], cov[2] += f[0] * f[2];
    cov[3] += f[1] * f[1], cov[4] += f[1] * f[2], cov[5] += f[2] * f[2];
}

/* The fault of each gauge that shows, weighed by its probability: odds of NO_FAULT to 1 before the sample. */
static void add_doubt(const tipforce_record *r, tipforce_verdict *v, const real explained[N], const real visible[N])
{
    double most = 0.0, likelihood[N], total;
    for (int k = 0; k < N; k++) {
        likelihood[k] = visible[k] * (real)r->noise[place(k, k)] >= LEAST_SHARE ? 1.0 : 0.0;
        most = likelihood[k] > 0.0 ? fmax(most, (double)explained[k]) : most;
    }
    total = NO_FAULT * exp(-0.5 * most);
    for (int k = 0; k < N; k++) {
        likelihood[k] *= exp(0.5 * fmin((double)explained[k] - most, 0.0));
        total += likelihood[k];
    }
    for (int k = 0; k < N; k++) {
        if (likelihood[k] > 0.0) {
            real size = (real)sqrt(likelihood[k] / total * (double)explained[k] / (double)visible[k]);
            real f[3] = {size * v->C[0][k], size * v->C[1][k], size * v->C[2][k]};
            add(v->cov, f);
        }
    }
}

static bool compensated(const tipforce_record *r)
{
    bool any = r->gain_per_K != 0.0;
    for (int k = 0; k < N; k++) {
        any = any || r->offset_per_K[k] != 0.0;
    }
    return any;
}

/* Kelvin that are compensated; *left: kelvin of uncertainty that remain. */
static double temperature(const tipforce_record *r, double degC, double *left, uint16_t *faults)
{
    bool ranged = r->lowest_degC != 0.0 || r->highest_degC != 0.0, needed = compensated(r);
    double kelvin = degC - r->reference_degC;
    *left = 0.0;
    if (degC - degC == 0.0 && 1.0 + r->gain_per_K * kelvin > 0.0) {
        if (ranged) {
            *left = fmax(fmax(r->lowest_degC - degC, degC - r->highest_degC), 0.0);
        }
        *faults |= *left > 0.0 ? TIPFORCE_FAULT_TEMPERATURE : 0;
        return needed ? kelvin : 0.0;
    }
    if (needed) {
        double a = r->lowest_degC - r->reference_degC, b = r->highest_degC - r->reference_degC;
        *faults |= TIPFORCE_FAULT_TEMPERATURE;
        *left = ranged ? sqrt((a * a + a * b + b * b) / 3.0) : UNSTATED_KELVIN;
    }
    return 0.0;
}

void tipforce_judge_setup(tipforce_judge *judge, const tipforce_record *record)
{
    judge->record = *record;
    set_subset(record, 0, &judge->all);
}

static void unknown(tipforce_verdict *v, uint8_t early)
{
    v->early |= early;
    for (int i = 0; i < 6; i++) {
        v->cov[i] = (real)NAN;
    }
}

static void judge_force(const tipforce_record *r, double gain, bool overloaded, double kelvin, tipforce_verdict *v)
{
    real F[3], warm[3], model = (real)r->model;
    for (int i = 0; i < 3; i++) {
        F[i] = warm[i] = 0;
        for (int k = 0; k < N; k++) {
            F[i] += v->C[i][k] * v->V[k];
            warm[i] += v->C[i][k] * (real)r->offset_per_K[k];
        }
        F[i] /= (real)gain;
        warm[i] = (warm[i] + (real)r->gain_per_K * F[i]) * (real)kelvin;
    }
    real hypotenuse = (real)sqrt((double)(F[0] * F[0] + F[2] * F[2]));
    real P = (real)fmax((double)hypotenuse, 0.5 * (double)(hypotenuse + (real)fabs((double)F[1])));
    if (r->calibrated_N > 0.0 && P > (real)r->calibrated_N) {
        v->faults |= TIPFORCE_FAULT_BEYOND_CALIBRATED;
        model *= P / (real)r->calibrated_N;
    }
    if (r->overload_N > 0.0 && P > (overloaded ? RELEASE : (real)1.0) * (real)r->overload_N) {
        v->faults |= TIPFORCE_FAULT_OVERLOAD;
        v->overloaded = true;
        v->early |= TIPFORCE_SATURATED;
    }
    for (int k = 0; k < N; k++) {
        real f[3];
        for (int i = 0; i < 3; i++) {
            f[i] = model * v->V[k] * v->C[i][k];
        }
        add(v->cov, f);
    }
    add(v->cov, warm);
    for (int k = 0; k < N; k++) {
        v->V[k] = (unsigned)v->faults >> k & 1u ? 0 : v->V[k] / (real)gain;
    }
}

void tipforce_judge_sample(const tipforce_judge *judge, const real strain[N], real degC, uint8_t lost, bool overloaded,
                           tipforce_verdict *v)
{
    const tipforce_record *r = &judge->record;
    tipforce_subset other;
    const tipforce_subset *s = &judge->all;
    real extra[N], explained[N] = {0}, visible[N] = {0};
    double left;
    memset(v, 0, sizeof *v);
    double kelvin = temperature(r, (double)degC, &left, &v->faults), gain = 1.0 + r->gain_per_K * kelvin;
    for (int k = 0; k < N; k++) {
        if (r->converter_limit[k] > 0.0 && fabs((double)strain[k]) >= r->converter_limit[k]) {
            lost |= (uint8_t)(1u << k);
        }
        /* A gauge that is lost may read NaN or infinity: its weight of zero alone would not take that away. */
        v->V[k] = (unsigned)lost >> k & 1u ? 0 : (real)((double)strain[k] - r->offset[k] - kelvin * r->offset_per_K[k]);
        extra[k] = (real)r->model * v->V[k] * (real)r->model * v->V[k];
    }
    if (lost) {
        set_subset(r, lost, &other);
        s = &other;
        v->early |= TIPFORCE_SATURATED;
    }
    int bits = s->usable && s->rows ? judged(s, v->V, extra, explained, visible) : -1;
    if (bits >= 0) {
        v->faults |= TIPFORCE_FAULT_CONTRADICTION;
        /* One bit alone; of four gauges the three that would be left cannot be checked. */
        unsigned gauge = s->rows > 1 && bits > 0 && (bits & (bits - 1)) == 0 ? (unsigned)bits : 0u;
        if (gauge) {
            set_subset(r, lost | gauge, &other);
            memset(explained, 0, sizeof explained);
        }
        if (!gauge || !other.usable || !other.rows || judged(&other, v->V, extra, explained, visible) >= 0) {
            unknown(v, TIPFORCE_FAULT);
            v->faults |= lost;
            return;
        }
        s = &other;
        lost |= (uint8_t)gauge;
        v->early |= TIPFORCE_SATURATED;
    }
    v->faults |= lost;
    if (!s->usable) {
        unknown(v, 0);
        return;
    }
    memcpy(v->C, s->C, sizeof v->C);
    memcpy(v->cov, s->cov, sizeof v->cov);
    add_doubt(r, v, explained, visible);
    judge_force(r, gain, overloaded, left, v);
    v->determined = lost != 0 && !v->overloaded;
}

void tipforce_judge_estimate(const tipforce_verdict *v, const tipforce_float_calibration *calibration,
                             const real tare[3], uint8_t early, bool was_present, tipforce_float_result *result)
{
    tipforce_float_calibration used = *calibration;
    memcpy(used.C, v->C, sizeof used.C);
    memcpy(used.cov, v->cov, sizeof used.cov);
    memset(used.offset, 0, sizeof used.offset);
    early |= v->early;
    /* The gauges left give the force: SATURATED takes nothing away. */
    unsigned said = v->determined ? early & ~(unsigned)TIPFORCE_SATURATED : early;
    tipforce_float_estimate(&used, v->V, tare, (uint8_t)said, was_present, result);
    result->status |= early;
}
