/* Force and contact from the gauges of a fingertip: F = C (strain - offset) - tare, then P, phi, theta, their standard
 * uncertainties and the status byte 2120h. The formulas are those of tipforce.sensor.contact.scalar; C99, no allocation, no
 * state, no library but math.h (float variant) or none (fixed-point variant).
 *
 * F1 = P sin(phi), F2 = P sin(phi - theta), F3 = P cos(phi). TIPFORCE_GAUGES comes from tipforce_od.h.
 */
#ifndef TIPFORCE_ESTIMATOR_H
#define TIPFORCE_ESTIMATOR_H

#include <stdbool.h>
#include <stdint.h>

#include "tipforce_od.h"

#ifndef TIPFORCE_REAL
#define TIPFORCE_REAL float /* or double: -DTIPFORCE_REAL=double -DTIPFORCE_DOUBLE */
#endif

/* Status byte. The caller knows CALIBRATED, SATURATED, STALE and FAULT and hands them in; the rest is added. */
enum {
    TIPFORCE_CONTACT_PRESENT = 0x01,
    TIPFORCE_CALIBRATED = 0x02,
    TIPFORCE_SATURATED = 0x04,
    TIPFORCE_STALE = 0x08,
    TIPFORCE_THETA_UNRESOLVED = 0x10,
    TIPFORCE_MISSES_TIP = 0x20,
    TIPFORCE_OUTSIDE_PAD = 0x40,
    TIPFORCE_FAULT = 0x80
};

/* What a status byte makes unknown. */
enum {
    TIPFORCE_UNKNOWN_FORCE = 0x01, /* F and P */
    TIPFORCE_UNKNOWN_PHI = 0x02,
    TIPFORCE_UNKNOWN_THETA = 0x04,
    TIPFORCE_UNKNOWN_GAUGES = 0x08
};

#define TIPFORCE_TRIANGLE (TIPFORCE_GAUGES * (TIPFORCE_GAUGES + 1) / 2)

/* ---- floating point: newtons, radians, strain (not microstrain) ---- */

typedef struct {
    TIPFORCE_REAL C[3][TIPFORCE_GAUGES];    /* 2100h, newtons per unit strain */
    TIPFORCE_REAL offset[TIPFORCE_GAUGES];  /* 2101h, strain */
    TIPFORCE_REAL cov[6];                   /* of F: 11, 12, 13, 22, 23, 33; by tipforce_float_covariance */
    TIPFORCE_REAL on_N, off_N;              /* 2110h:4, 2110h:5 */
    TIPFORCE_REAL theta_min_deg, theta_max_deg;
    bool pull;                              /* 2110h:6 */
} tipforce_float_calibration;

typedef struct {
    TIPFORCE_REAL F[3], P, phi, theta, miss; /* NaN where unknown */
    TIPFORCE_REAL u_P, u_phi, u_theta;
    uint8_t status;
} tipforce_float_result;

/* cov = C noise C^T; noise is the upper triangle 2106h by rows, strain^2. */
void tipforce_float_covariance(tipforce_float_calibration *calibration,
                               const TIPFORCE_REAL noise[TIPFORCE_TRIANGLE]);

/* early: the bits that the caller knows; was_present: the sample before had CONTACT_PRESENT. */
void tipforce_float_estimate(const tipforce_float_calibration *calibration,
                             const TIPFORCE_REAL strain[TIPFORCE_GAUGES], const TIPFORCE_REAL tare[3],
                             uint8_t early, bool was_present, tipforce_float_result *result);

/* ---- fixed point ----
 *
 * It does not judge (tipforce_judge.h, floating point): bits 12 to 15 of 2124h stay clear, no gauge is left out, and u is
 * that of gauge noise alone. The caller passes SATURATED or FAULT at 2113h, compares P with 2112h:1 and 2, and either
 * leaves 2116h at 0 or calls tipforce_judge_sample() first.
 */

#define TIPFORCE_FORCE_BITS 20           /* forces are in 2^-20 N, about 1 micronewton; up to 1024 N */
#define TIPFORCE_UNITS_LIMIT 134217728   /* 2^27: largest gauge reading, in units */

typedef struct {
    int32_t C[3][TIPFORCE_GAUGES]; /* newtons per unit, times 2^(20 + shift) */
    int64_t bias[3];               /* C offset, times 2^(20 + shift) */
    int32_t K[6];                  /* covariance of F, times 2^(30 - 2 half) */
    int32_t half;
    int32_t on, off;               /* 2^-20 N */
    uint32_t theta_min, pad_width; /* 2^-32 turn; all ones: the whole turn */
    uint8_t shift;
    bool pull;
} tipforce_fixed_calibration;

typedef struct {
    int32_t F[3], P, miss;         /* 2^-20 N */
    int32_t phi, theta;            /* 2^-32 turn: -2^31 is 180 degrees */
    int32_t u_P;                   /* 2^-20 N */
    uint32_t u_phi, u_theta;       /* 2^-32 turn; all ones: a turn or more */
    uint8_t status;
    uint8_t unknown;               /* TIPFORCE_UNKNOWN_...: what of the above has no value */
} tipforce_fixed_result;

/* Once, when a calibration becomes active; in double precision. strain_per_unit: of one count or of 0.1 microstrain
 * (1e-7). False: a number is not finite, C is zero, or a force limit is over 1023 N. */
bool tipforce_fixed_setup(tipforce_fixed_calibration *calibration, const double C[3][TIPFORCE_GAUGES],
                          const double offset[TIPFORCE_GAUGES], const double noise[TIPFORCE_TRIANGLE],
                          double strain_per_unit, const double limits[4], bool pull);

/* units: counts or 0.1 microstrain, as in the setup. tare in 2^-20 N. A reading beyond TIPFORCE_UNITS_LIMIT or a force
 * beyond 1024 N sets SATURATED. */
void tipforce_fixed_estimate(const tipforce_fixed_calibration *calibration, const int32_t units[TIPFORCE_GAUGES],
                             const int32_t tare[3], uint8_t early, bool was_present, tipforce_fixed_result *result);

int32_t tipforce_fixed_millinewtons(int32_t force);  /* rounded, as 7130h has it */
int32_t tipforce_fixed_centidegrees(int32_t angle);  /* -17999 to 18000 */

/* ---- both ---- */

uint8_t tipforce_unknown(uint8_t status);

#endif
