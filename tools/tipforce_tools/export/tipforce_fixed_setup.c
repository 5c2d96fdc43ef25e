/* From a calibration to the constants of the fixed-point variant; see tipforce_estimator.h. */
#include "tipforce_estimator.h"

#include <math.h>

#define PAD_SLACK_DEG 1e-4

static int32_t rounded(double value) { return (int32_t)llround(value); }

static bool matrix(tipforce_fixed_calibration *c, const double C[3][TIPFORCE_GAUGES],
                   const double offset[TIPFORCE_GAUGES], double strain_per_unit)
{
    double largest = 0.0;
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < TIPFORCE_GAUGES; k++) {
            double one = fabs(C[i][k] * strain_per_unit);
            largest = one > largest ? one : largest;
            if (!(one <= 1e6)) {
                return false;
            }
        }
    }
    if (!(largest > 0.0)) {
        return false;
    }
    int exponent = 0;
    (void)frexp(largest, &exponent); /* largest < 2^exponent: C stays below 2^31 */
    int shift = 31 - TIPFORCE_FORCE_BITS - exponent;
    if (shift < 0) {
        return false;
    }
    shift = shift > 40 ? 40 : shift;
    c->shift = (uint8_t)shift;
    for (int i = 0; i < 3; i++) {
        double bias = 0.0;
        for (int k = 0; k < TIPFORCE_GAUGES; k++) {
            double scaled = ldexp(C[i][k] * strain_per_unit, TIPFORCE_FORCE_BITS + shift);
            if (scaled > 2147483647.0) {
                scaled = 2147483647.0;
            }
            c->C[i][k] = rounded(scaled);
            bias += C[i][k] * offset[k];
        }
        bias = ldexp(bias, TIPFORCE_FORCE_BITS + shift);
        if (!(fabs(bias) < 1e18)) {
            return false;
        }
        c->bias[i] = llround(bias);
    }
    return true;
}

static bool covariance(tipforce_fixed_calibration *c, const double C[3][TIPFORCE_GAUGES],
                       const double noise[TIPFORCE_TRIANGLE])
{
    double cov[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    int place = 0;
    for (int j = 0; j < TIPFORCE_GAUGES; j++) {
        for (int k = j; k < TIPFORCE_GAUGES; k++, place++) {
            int at = 0;
            for (int a = 0; a < 3; a++) {
                for (int b = a; b < 3; b++, at++) {
                    cov[at] += noise[place] * (C[a][j] * C[b][k] + (j == k ? 0.0 : C[a][k] * C[b][j]));
                }
            }
        }
    }
    double largest = fmax(fmax(cov[0], cov[3]), fmax(cov[5], 0.0));
    int exponent = 0;
    if (!(largest < 1e6 && cov[0] - cov[0] == 0.0)) { /* fmax drops a NaN, which is in every sum */
        return false;
    }
    (void)frexp(largest, &exponent);
    c->half = largest > 0.0 ? (exponent + 1 - (((exponent + 1) % 2 + 2) % 2)) / 2 : -60;
    for (int k = 0; k < 6; k++) {
        c->K[k] = rounded(ldexp(cov[k], 30 - 2 * c->half));
    }
    return true;
}

static uint32_t turns(double degrees) /* modulo a turn */
{
    double turn = degrees / 360.0;
    return (uint32_t)(uint64_t)llround(ldexp(turn - floor(turn), 32));
}

bool tipforce_fixed_setup(tipforce_fixed_calibration *c, const double C[3][TIPFORCE_GAUGES],
                          const double offset[TIPFORCE_GAUGES], const double noise[TIPFORCE_TRIANGLE],
                          double strain_per_unit, const double limits[4], bool pull)
{
    double width = limits[3] - limits[2] + 2.0 * PAD_SLACK_DEG;
    if (!matrix(c, C, offset, strain_per_unit) || !covariance(c, C, noise)) {
        return false;
    }
    if (!(fabs(limits[0]) < 1023.0 && fabs(limits[1]) < 1023.0 && fabs(limits[2]) < 1e6 && width > 0.0)) {
        return false;
    }
    c->on = rounded(ldexp(limits[0], TIPFORCE_FORCE_BITS));
    c->off = rounded(ldexp(limits[1], TIPFORCE_FORCE_BITS));
    c->theta_min = turns(limits[2] - PAD_SLACK_DEG);
    c->pad_width = width < 360.0 ? turns(width) : UINT32_MAX;
    c->pull = pull;
    return true;
}
