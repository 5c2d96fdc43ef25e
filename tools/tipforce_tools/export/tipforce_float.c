/* The float variant; see tipforce_estimator.h. Line by line the formulas of tipforce.sensor.contact.scalar. */
#include "tipforce_estimator.h"

#include <math.h>

typedef TIPFORCE_REAL real;

#ifdef TIPFORCE_DOUBLE
#define F(name) name
#else
#define F(name) name##f
#endif

typedef char tipforce_both_or_none[sizeof(real) > sizeof(F(fabs)((real)0)) ? -1 : 1]; /* REAL=double and DOUBLE */

#define PI ((real)3.14159265358979323846)
#define DEGREES ((real)57.295779513082320877)
#define MISS_COVERAGE_FACTOR ((real)3.0)
#define MISS_FLOOR ((real)1e-6)
#define THETA_RESOLVED_DEG ((real)30.0)
#define SMALLEST_STEP ((real)1e-30)
#define SMALLEST_COSINE ((real)1e-15)
#define PAD_SLACK_DEG ((real)1e-4)
#define ZERO ((real)0.0)
#define ONE ((real)1.0)
#define TWO ((real)2.0)
#define HALF ((real)0.5)

/* A force scaled by a power of two: F = f 2^exponent, cov = K 2^(2 half). Nothing over- or underflows. */
typedef struct {
    real f1, f2, f3, hypotenuse, cosine_squared, cosine, K[6];
    int exponent, half;
} scaled;

static real larger(real a, real b) { return a > b ? a : b; }
static real smaller(real a, real b) { return a < b ? a : b; }

static real times_power(real value, int exponent)
{
    int first = exponent / 2;
    return value * F(ldexp)(ONE, first) * F(ldexp)(ONE, exponent - first);
}

static void scale_force(scaled *s, const real force[3])
{
    int exponent = 0;
    real a1 = F(fabs)(force[0]), a2 = F(fabs)(force[1]), a3 = F(fabs)(force[2]);
    (void)F(frexp)(larger(a1, larger(a2, a3)), &exponent);
    s->exponent = exponent;
    s->f1 = F(ldexp)(force[0], -exponent);
    s->f2 = F(ldexp)(force[1], -exponent);
    s->f3 = F(ldexp)(force[2], -exponent);
    a1 = F(fabs)(s->f1), a2 = F(fabs)(s->f2), a3 = F(fabs)(s->f3);
    real large = larger(a1, a3), small = smaller(a1, a3);
    s->hypotenuse = F(sqrt)(large * large + small * small);
    /* P^2 - F2^2 in factors: no digit is lost where small is tiny, half of the digits at most elsewhere. */
    s->cosine_squared = (large - a2) * (large + a2) + small * small;
    s->cosine = F(sqrt)(larger(ZERO, s->cosine_squared));
}

static void scale_covariance(scaled *s, const real cov[6])
{
    int exponent = 0;
    (void)F(frexp)(larger(larger(cov[0], cov[3]), larger(cov[5], ZERO)), &exponent);
    /* Rounded towards minus infinity, as in Python; any rounding would do. */
    s->half = (exponent + 1 - (((exponent + 1) % 2 + 2) % 2)) / 2;
    for (int k = 0; k < 6; k++) {
        s->K[k] = F(ldexp)(cov[k], -2 * s->half);
    }
}

static void contact(const scaled *s, bool pull, tipforce_float_result *r)
{
    real a2 = F(fabs)(s->f2), unit = F(ldexp)(ONE, s->exponent - 1);
    r->miss = ZERO;
    r->P = TWO * s->hypotenuse * unit;
    if (s->cosine_squared < ZERO) {
        real excess = -s->cosine_squared / (a2 + s->hypotenuse);
        r->P = (TWO * s->hypotenuse + excess) * unit;
        r->miss = TWO * excess * unit;
    }
    r->phi = r->theta = NAN;
    if (!(s->f1 == ZERO && s->f3 == ZERO)) {
        real phi = F(atan2)(s->f1 + ZERO, s->f3);
        if (phi <= -PI) {
            phi = PI;
        }
        real theta = phi - F(atan2)(s->f2, pull ? s->cosine : -s->cosine);
        if (theta > PI) {
            theta -= TWO * PI;
        } else if (theta <= -PI) {
            theta += TWO * PI;
        }
        r->phi = phi;
        r->theta = theta;
    }
}

static real deviation(const real K[6], real g1, real g2, real g3)
{
    real variance = g1 * (K[0] * g1 + TWO * (K[1] * g2 + K[2] * g3)) + g2 * (K[3] * g2 + TWO * K[4] * g3) +
                    g3 * K[5] * g3;
    return F(sqrt)(larger(ZERO, variance));
}

static real worst_deviation(const real K[6])
{
    real difference = HALF * (K[0] - K[5]);
    real largest = HALF * (K[0] + K[5]) + F(sqrt)(difference * difference + K[2] * K[2]);
    return F(sqrt)(larger(ZERO, largest));
}

static real arc(real x, real cosine, real step)
{
    real other = F(sqrt)(larger(ZERO, cosine * cosine - step * (TWO * x + step)));
    real total = cosine + other;
    real ratio = total > ZERO ? (TWO * x + step) / total : ZERO;
    return TWO * F(asin)(smaller(ONE, HALF * F(fabs)(step) * F(sqrt)(ONE + ratio * ratio)));
}

static real finite_slope(real x, real cosine, real step)
{
    if (step < SMALLEST_STEP) {
        return ONE / larger(cosine, SMALLEST_COSINE);
    }
    real inward = arc(x, cosine, -smaller(step, ONE + x));
    real outward = arc(x, cosine, smaller(step, cosine * cosine / (ONE + x)));
    return F(sqrt)(HALF * (inward * inward + outward * outward)) / step;
}

static void uncertainty(const scaled *s, bool pull, tipforce_float_result *r)
{
    r->u_phi = r->u_theta = NAN;
    if (s->hypotenuse == ZERO) {
        r->u_P = times_power(worst_deviation(s->K), s->half);
        return;
    }
    real n1 = s->f1 / s->hypotenuse, n3 = s->f3 / s->hypotenuse;
    real P = larger(s->hypotenuse, HALF * (s->hypotenuse + F(fabs)(s->f2)));
    real x = larger(-ONE, smaller(ONE, s->f2 / s->hypotenuse));
    real g1 = -x * n1, g3 = -x * n3;
    real step = times_power(deviation(s->K, g1, ONE, g3) / P, s->half - s->exponent);
    real slope = finite_slope(F(fabs)(x), s->cosine / s->hypotenuse, step);
    if (!pull) {
        slope = -slope;
    }
    r->u_P = times_power(deviation(s->K, n1, ZERO, n3), s->half);
    r->u_phi = times_power(deviation(s->K, n3, ZERO, -n1) / P, s->half - s->exponent);
    r->u_theta = times_power(deviation(s->K, n3 - slope * g1, -slope, -n1 - slope * g3) / P, s->half - s->exponent);
}

static real miss_uncertainty(const scaled *s)
{
    if (s->hypotenuse == ZERO) {
        return times_power(worst_deviation(s->K) + F(sqrt)(larger(ZERO, s->K[3])), s->half);
    }
    real sign = s->f2 < ZERO ? -ONE : ONE;
    return times_power(deviation(s->K, -s->f1 / s->hypotenuse, sign, -s->f3 / s->hypotenuse), s->half);
}

static uint8_t status_bits(const tipforce_float_calibration *c, const scaled *s, bool was_present,
                           const tipforce_float_result *r)
{
    unsigned bits = 0;
    if (r->P >= (was_present ? c->off_N : c->on_N)) {
        bits = TIPFORCE_CONTACT_PRESENT;
    }
    bool resolved = r->P >= c->off_N && r->u_P >= ZERO && r->u_theta * DEGREES <= THETA_RESOLVED_DEG &&
                    F(fabs)(r->theta) <= PI;
    if (!resolved) {
        bits |= TIPFORCE_THETA_UNRESOLVED;
    }
    real u_miss = r->miss > ZERO ? miss_uncertainty(s) : ZERO;
    if (r->miss > MISS_COVERAGE_FACTOR * u_miss + MISS_FLOOR * r->P) {
        bits |= TIPFORCE_MISSES_TIP;
    }
    if (bits == TIPFORCE_CONTACT_PRESENT) {
        real past_start = F(fmod)(r->theta * DEGREES - c->theta_min_deg + PAD_SLACK_DEG, (real)360.0);
        if (past_start < ZERO) {
            past_start += (real)360.0;
        }
        if (past_start > c->theta_max_deg - c->theta_min_deg + TWO * PAD_SLACK_DEG) {
            bits |= TIPFORCE_OUTSIDE_PAD;
        }
    }
    return (uint8_t)bits;
}

void tipforce_float_covariance(tipforce_float_calibration *c, const real noise[TIPFORCE_TRIANGLE])
{
    int place = 0;
    for (int i = 0; i < 6; i++) {
        c->cov[i] = ZERO;
    }
    for (int j = 0; j < TIPFORCE_GAUGES; j++) {
        for (int k = j; k < TIPFORCE_GAUGES; k++, place++) {
            int at = 0;
            for (int a = 0; a < 3; a++) {
                for (int b = a; b < 3; b++, at++) {
                    real both = c->C[a][j] * c->C[b][k] + (j == k ? ZERO : c->C[a][k] * c->C[b][j]);
                    c->cov[at] += noise[place] * both;
                }
            }
        }
    }
}

void tipforce_float_estimate(const tipforce_float_calibration *c, const real strain[TIPFORCE_GAUGES],
                             const real tare[3], uint8_t early, bool was_present, tipforce_float_result *r)
{
    scaled s;
    real check = ZERO;
    for (int i = 0; i < 3; i++) {
        real sum = ZERO;
        for (int k = 0; k < TIPFORCE_GAUGES; k++) {
            sum += c->C[i][k] * (strain[k] - c->offset[k]);
        }
        r->F[i] = sum - tare[i];
        check += r->F[i] - r->F[i];
    }
    for (int i = 0; i < 6; i++) {
        check += c->cov[i] - c->cov[i];
    }
    r->P = r->phi = r->theta = r->miss = r->u_P = r->u_phi = r->u_theta = NAN;
    r->status = early;
    if (tipforce_unknown(early) & TIPFORCE_UNKNOWN_FORCE) {
        r->F[0] = r->F[1] = r->F[2] = NAN;
        return;
    }
    if (check != ZERO) { /* true for NaN and infinity only */
        r->status = (uint8_t)(early | TIPFORCE_THETA_UNRESOLVED);
        return;
    }
    scale_force(&s, r->F);
    scale_covariance(&s, c->cov);
    contact(&s, c->pull, r);
    uncertainty(&s, c->pull, r);
    r->status = (uint8_t)(early | status_bits(c, &s, was_present, r));
}
