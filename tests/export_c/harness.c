/* Reads calibrations and samples from standard input, writes what both variants make of them to standard output.
 * A block: C, offset, noise, strain_per_unit, limits (doubles), pull, count (int32); then count samples: strain
 * (doubles), units, tare, early, was_present (int32). A result: twelve doubles, of the float variant, then of the
 * fixed-point one: F, P, phi, theta, miss, u_P, u_phi, u_theta, status, unknown; in newtons and radians. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "tipforce_estimator.h"

#define N TIPFORCE_GAUGES
#define TURN 6.283185307179586476925

typedef struct {
    double C[3][N], offset[N], noise[TIPFORCE_TRIANGLE], strain_per_unit, limits[4];
    int32_t pull, count;
} block;

typedef struct {
    double strain[N];
    int32_t units[N], tare[3], early, was_present[1 + (N + 5) % 2];
} sample;

static void write_out(const double out[12])
{
    if (fwrite(out, sizeof(double), 12, stdout) != 12) {
        exit(1);
    }
}

static void one(const tipforce_float_calibration *f, const tipforce_fixed_calibration *q, const sample *s)
{
    tipforce_float_result r;
    tipforce_fixed_result i;
    TIPFORCE_REAL strain[N], tare[3];
    for (int k = 0; k < N; k++) {
        strain[k] = (TIPFORCE_REAL)s->strain[k];
    }
    for (int k = 0; k < 3; k++) {
        tare[k] = (TIPFORCE_REAL)ldexp(s->tare[k], -TIPFORCE_FORCE_BITS);
    }
    tipforce_float_estimate(f, strain, tare, (uint8_t)s->early, s->was_present[0] != 0, &r);
    double real[12] = {(double)r.F[0], (double)r.F[1], (double)r.F[2], (double)r.P, (double)r.phi, (double)r.theta,
                       (double)r.miss, (double)r.u_P, (double)r.u_phi, (double)r.u_theta, r.status,
                       tipforce_unknown(r.status)};
    write_out(real);
    tipforce_fixed_estimate(q, s->units, s->tare, (uint8_t)s->early, s->was_present[0] != 0, &i);
    const double force = ldexp(1.0, -TIPFORCE_FORCE_BITS), turn = ldexp(TURN, -32);
    double fixed[12] = {i.F[0] * force, i.F[1] * force, i.F[2] * force, i.P * force, i.phi * turn, i.theta * turn,
                        i.miss * force, i.u_P * force, i.u_phi * turn, i.u_theta * turn, i.status, i.unknown};
    write_out(fixed);
    if (abs(tipforce_fixed_millinewtons(i.P) - (int)lround(1000.0 * fixed[3])) > 1 ||
        abs(tipforce_fixed_centidegrees(i.phi)) > 18000 || tipforce_fixed_centidegrees(i.phi) == -18000) {
        exit(2);
    }
}

static void calibrate(const block *b, tipforce_float_calibration *f, tipforce_fixed_calibration *q)
{
    TIPFORCE_REAL noise[TIPFORCE_TRIANGLE];
    for (int k = 0; k < N; k++) {
        f->offset[k] = (TIPFORCE_REAL)b->offset[k];
        for (int i = 0; i < 3; i++) {
            f->C[i][k] = (TIPFORCE_REAL)b->C[i][k];
        }
    }
    for (int k = 0; k < TIPFORCE_TRIANGLE; k++) {
        noise[k] = (TIPFORCE_REAL)b->noise[k];
    }
    tipforce_float_covariance(f, noise);
    f->on_N = (TIPFORCE_REAL)b->limits[0];
    f->off_N = (TIPFORCE_REAL)b->limits[1];
    f->theta_min_deg = (TIPFORCE_REAL)b->limits[2];
    f->theta_max_deg = (TIPFORCE_REAL)b->limits[3];
    f->pull = b->pull != 0;
    if (!tipforce_fixed_setup(q, (const double(*)[N])b->C, b->offset, b->noise, b->strain_per_unit, b->limits,
                              f->pull)) {
        exit(3);
    }
}

int main(void)
{
    block b;
    sample s;
    tipforce_float_calibration f;
    tipforce_fixed_calibration q;
    while (fread(&b, sizeof b, 1, stdin) == 1) {
        calibrate(&b, &f, &q);
        for (int k = 0; k < b.count; k++) {
            if (fread(&s, sizeof s, 1, stdin) != 1) {
                return 4;
            }
            one(&f, &q, &s);
        }
    }
    return 0;
}
