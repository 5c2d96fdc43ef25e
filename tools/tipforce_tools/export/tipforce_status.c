/* What a status byte makes unknown; see tipforce_estimator.h. */
#include "tipforce_estimator.h"

uint8_t tipforce_unknown(uint8_t status)
{
    unsigned bits = 0;
    if (status & (TIPFORCE_STALE | TIPFORCE_FAULT)) {
        bits = TIPFORCE_UNKNOWN_GAUGES | TIPFORCE_UNKNOWN_FORCE | TIPFORCE_UNKNOWN_PHI | TIPFORCE_UNKNOWN_THETA;
    }
    if (!(status & TIPFORCE_CALIBRATED) || (status & TIPFORCE_SATURATED)) {
        bits |= TIPFORCE_UNKNOWN_FORCE | TIPFORCE_UNKNOWN_PHI | TIPFORCE_UNKNOWN_THETA;
    }
    if (!(status & TIPFORCE_CONTACT_PRESENT)) {
        bits |= TIPFORCE_UNKNOWN_PHI | TIPFORCE_UNKNOWN_THETA;
    }
    if (status & (TIPFORCE_THETA_UNRESOLVED | TIPFORCE_MISSES_TIP)) {
        bits |= TIPFORCE_UNKNOWN_THETA;
    }
    return (uint8_t)bits;
}
