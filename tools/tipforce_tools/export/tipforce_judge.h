/* What a calibration says of one sample: bits 12 to 15 of 2124h, the gauge that contradicts the others, and the matrix and
 * covariance that remain. The formulas are those of tipforce.fingertip.judgement and sensor.contact.scalar_redundancy.
 * Floating point (TIPFORCE_REAL); what is worked out once for each set of gauges is in double precision.
 */
#ifndef TIPFORCE_JUDGE_H
#define TIPFORCE_JUDGE_H

#include "tipforce_estimator.h"

/* Of 2124h; bits 0 to 7 are gauges 1 to 8. */
enum {
    TIPFORCE_FAULT_CONTRADICTION = 0x1000,
    TIPFORCE_FAULT_BEYOND_CALIBRATED = 0x2000,
    TIPFORCE_FAULT_TEMPERATURE = 0x4000,
    TIPFORCE_FAULT_OVERLOAD = 0x8000
};

/* 2100h to 2116h as far as a sample is judged by them. */
typedef struct {
    double C[3][TIPFORCE_GAUGES], offset[TIPFORCE_GAUGES], noise[TIPFORCE_TRIANGLE];
    double reference_degC;                         /* 2102h:3 */
    double calibrated_N, overload_N;               /* 2112h:1, 2; 0 not known */
    double lowest_degC, highest_degC, model;       /* 2112h:3, 4 (both 0 not known), 5 */
    double converter_limit[TIPFORCE_GAUGES];       /* 2113h, strain; 0 not known */
    double offset_per_K[TIPFORCE_GAUGES], gain_per_K; /* 2114h, 2115h */
    double redundancy_limit;                       /* 2116h; 0 off */
} tipforce_record;

typedef struct {
    TIPFORCE_REAL C[3][TIPFORCE_GAUGES], cov[6];   /* zero columns for the gauges left out */
    TIPFORCE_REAL W[TIPFORCE_GAUGES - 3 + 1][TIPFORCE_GAUGES];
    TIPFORCE_REAL alarm, exclusion;
    uint8_t shown;                                 /* bit per gauge whose fault the residuals show */
    uint8_t rows;                                  /* of W; 0: nothing to check by */
    bool usable;                                   /* the gauges have rank 3 */
} tipforce_subset;

typedef struct {
    tipforce_record record;
    tipforce_subset all;
} tipforce_judge;

typedef struct {
    uint16_t faults;                               /* gauges left out or saturated, and bits 12 to 15 */
    uint8_t early;                                 /* SATURATED, FAULT */
    bool determined;                               /* a gauge is left out and the others give the force */
    bool overloaded;                               /* hand it in with the next sample */
    TIPFORCE_REAL V[TIPFORCE_GAUGES];              /* strain without offset and temperature; 0 for gauges left out */
    TIPFORCE_REAL C[3][TIPFORCE_GAUGES], cov[6];   /* for the estimate of V, whose offset is zero then */
} tipforce_verdict;

/* Once, when a calibration becomes active. */
void tipforce_judge_setup(tipforce_judge *judge, const tipforce_record *record);

/* strain as 6130h; temperature_degC NaN where it is not known; lost: gauges that have failed, saturated ones included. */
void tipforce_judge_sample(const tipforce_judge *judge, const TIPFORCE_REAL strain[TIPFORCE_GAUGES],
                           TIPFORCE_REAL temperature_degC, uint8_t lost, bool overloaded, tipforce_verdict *verdict);

/* tipforce_float_estimate() of a judged sample: with its matrix and covariance; of the calibration its limits and pull. */
void tipforce_judge_estimate(const tipforce_verdict *verdict, const tipforce_float_calibration *calibration,
                             const TIPFORCE_REAL tare[3], uint8_t early, bool was_present,
                             tipforce_float_result *result);

#endif
