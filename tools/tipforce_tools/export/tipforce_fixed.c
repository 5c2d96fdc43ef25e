/* The fixed-point variant; see tipforce_estimator.h. Integers only: 64 bits in sums, squares are exact.
 *
 * Within: forces are shifted until the largest has 30 bits, so squares have 60 and the sum of two 61; a square root or a
 * quotient is then good to 2^-29. An angle is 2^-40 turn while it is found, 2^-32 outside.
 */
#include "tipforce_estimator.h"

#define FORCE_LIMIT ((int64_t)1 << 30)
#define RAD_TO_TURN 683565276u      /* 2^32 / (2 pi) */
#define TURN_TO_RAD 26986075409u    /* 2 pi 2^32 */
#define RESOLVED (UINT32_MAX / 12u) /* 30 degrees */
#define SMALL_STEP 65536u           /* 2^-16, in 2^-32: below it an arc is as long as its sine to 3e-6 */
#define LARGEST_STEP ((uint64_t)1 << 52)
#define ROTATIONS 32

/* atan(2^-k) in 2^-40 turn. */
static const int64_t ARC_TANGENT[ROTATIONS] = {
    137438953472, 81134951838, 42869480287, 21761217566, 10922836750, 5466743129,
    2734038620, 1367102738, 683561799, 341782203, 170891265, 85445653,
    42722829, 21361415, 10680707, 5340354, 2670177, 1335088,
    667544, 333772, 166886, 83443, 41722, 20861,
    10430, 5215, 2608, 1304, 652, 326,
    163, 81,
};

typedef struct {
    int64_t f1, f2, f3; /* F times 2^up, the largest with 30 bits */
    uint64_t hypotenuse_squared, hypotenuse, cosine;
    int64_t cosine_squared;
    int up;
} scaled;

static uint64_t magnitude(int64_t value) { return value < 0 ? (uint64_t)-value : (uint64_t)value; }

static int bits(uint64_t value)
{
    int count = 0;
    for (int step = 32; step; step /= 2) {
        if (value >> step) {
            value >>= step;
            count += step;
        }
    }
    return count + (int)value;
}

static uint64_t root(uint64_t value) /* rounded down */
{
    uint64_t found = 0, bit = (uint64_t)1 << 62;
    while (bit > value) {
        bit >>= 2;
    }
    while (bit) {
        if (value >= found + bit) {
            value -= found + bit;
            found = (found >> 1) + bit;
        } else {
            found >>= 1;
        }
        bit >>= 2;
    }
    return found;
}

static uint64_t shifted(uint64_t value, int left, uint64_t limit) /* value 2^left, rounded, up to limit */
{
    if (left >= 0) {
        return bits(value) + left > 63 || value << left > limit ? limit : value << left;
    }
    if (left < -63) {
        return 0;
    }
    uint64_t found = ((value >> (-left - 1)) + 1) >> 1;
    return found > limit ? limit : found;
}

static int64_t divided(int64_t value, int64_t by) /* rounded to nearest; by > 0 */
{
    return value < 0 ? -((-value + by / 2) / by) : (value + by / 2) / by;
}

static int64_t reduced(int64_t value, int by) /* value 2^-by, rounded to nearest */
{
    uint64_t nearest = by ? (magnitude(value) + ((uint64_t)1 << (by - 1))) >> by : magnitude(value);
    return value < 0 ? -(int64_t)nearest : (int64_t)nearest;
}

static uint64_t times_32(uint64_t a, uint64_t b) /* a b 2^-32; b below 2^32 */
{
    return (a >> 32) * b + (((a & 0xFFFFFFFFu) * b) >> 32);
}

/* The angle of (x, y) in 2^-32 turn; both below 2^31. Rotations by arc tangents of powers of two (CORDIC). */
static uint32_t angle(int64_t y, int64_t x)
{
    int64_t turn = 0;
    uint64_t most = magnitude(x) > magnitude(y) ? magnitude(x) : magnitude(y);
    int64_t up = (int64_t)1 << (46 - bits(most));
    x *= up;
    y *= up;
    if (x < 0) {
        x = -x;
        y = -y;
        turn = (int64_t)1 << 39;
    }
    for (int k = 0; k < ROTATIONS; k++) {
        int64_t dx = (int64_t)(magnitude(y) >> k), dy = x >> k; /* x is positive here */
        if (y > 0) {
            x += dx;
            y -= dy;
            turn += ARC_TANGENT[k];
        } else if (y < 0) {
            x += dx;
            y += dy;
            turn -= ARC_TANGENT[k];
        } else {
            break;
        }
    }
    return (uint32_t)((((uint64_t)turn) + 128u) >> 8);
}

static void scale(scaled *s, const int32_t F[3])
{
    uint64_t most = 0;
    for (int i = 0; i < 3; i++) {
        most = magnitude(F[i]) > most ? magnitude(F[i]) : most;
    }
    s->up = 30 - bits(most);
    int64_t factor = (int64_t)1 << s->up;
    s->f1 = F[0] * factor;
    s->f2 = F[1] * factor;
    s->f3 = F[2] * factor;
    s->hypotenuse_squared = (uint64_t)(s->f1 * s->f1) + (uint64_t)(s->f3 * s->f3);
    s->hypotenuse = root(s->hypotenuse_squared);
    s->cosine_squared = (int64_t)s->hypotenuse_squared - s->f2 * s->f2;
    s->cosine = s->cosine_squared > 0 ? root((uint64_t)s->cosine_squared) : 0;
}

static void contact(const scaled *s, bool pull, tipforce_fixed_result *r)
{
    uint64_t P = s->hypotenuse, miss = 0;
    if (s->cosine_squared < 0) {
        miss = magnitude(s->cosine_squared) / (magnitude(s->f2) + s->hypotenuse);
        P += miss / 2;
    }
    r->P = (int32_t)shifted(P, -s->up, INT32_MAX);
    r->miss = (int32_t)shifted(miss, -s->up, INT32_MAX);
    if (s->f1 == 0 && s->f3 == 0) {
        r->unknown |= TIPFORCE_UNKNOWN_PHI | TIPFORCE_UNKNOWN_THETA;
        return;
    }
    uint32_t phi = angle(s->f1, s->f3);
    uint32_t normal = angle(s->f2, pull ? (int64_t)s->cosine : -(int64_t)s->cosine);
    r->phi = (int32_t)phi;
    r->theta = (int32_t)(phi - normal);
}

/* sqrt(g K g); g in any unit with at most 28 bits, the result in that unit. */
static uint64_t deviation(const int32_t K[6], int64_t g1, int64_t g2, int64_t g3)
{
    int64_t t1 = reduced(K[0] * g1 + K[1] * g2 + K[2] * g3, 30);
    int64_t t2 = reduced(K[1] * g1 + K[3] * g2 + K[4] * g3, 30);
    int64_t t3 = reduced(K[2] * g1 + K[4] * g2 + K[5] * g3, 30);
    int64_t variance = t1 * g1 + t2 * g2 + t3 * g3;
    return variance > 0 ? root((uint64_t)variance) : 0;
}

static uint64_t worst_deviation(const int32_t K[6]) /* 2^-15 */
{
    int64_t difference = ((int64_t)K[0] - K[5]) / 2, middle = ((int64_t)K[0] + K[5]) / 2, k13 = K[2];
    int64_t largest = middle + (int64_t)root((uint64_t)(difference * difference + k13 * k13));
    return largest > 0 ? root((uint64_t)largest) : 0;
}

/* Length of the arc from x to x + step on the unit circle, over step, in 2^-12: all lengths in units of the
 * hypotenuse; step_32 in 2^-32, taken outwards (to 1 at most) or inwards (to -1 at most). */
static uint64_t chord(const scaled *s, uint64_t x, uint64_t step_32, bool outwards)
{
    bool whole = step_32 >= (uint64_t)1 << 33; /* 2: longer than any way there is */
    uint64_t product = whole ? 0 : step_32 * s->hypotenuse, step = product >> 32;
    int64_t cosine_squared = s->cosine_squared > 0 ? s->cosine_squared : 0;
    uint64_t room = outwards ? (uint64_t)cosine_squared / (s->hypotenuse + x) : s->hypotenuse + x;
    if (whole || step >= room) { /* the whole way: the other end lies at 1 or at -1 */
        uint32_t end = outwards ? 1u << 30 : 3u << 30;
        uint32_t arc = angle((int64_t)x, (int64_t)s->cosine) - end;
        arc = outwards ? 0u - arc : arc;
        uint64_t radians_32 = times_32(TURN_TO_RAD, arc);
        return step_32 ? (radians_32 << 12) / step_32 : 0;
    }
    uint64_t along = outwards ? 2 * x + step : 2 * x - step;
    int64_t moved = outwards || 2 * x >= step ? (int64_t)times_32(product, along)
                                              : -(int64_t)times_32(product, step - 2 * x);
    int64_t rest = outwards ? cosine_squared - moved : cosine_squared + moved;
    uint64_t other = rest > 0 ? root((uint64_t)rest) : 0;
    if (step_32 >= SMALL_STEP) {
        uint32_t here = angle((int64_t)x, (int64_t)s->cosine);
        uint32_t there = angle(outwards ? (int64_t)(x + step) : (int64_t)x - (int64_t)step, (int64_t)other);
        uint64_t radians_32 = times_32(TURN_TO_RAD, outwards ? there - here : here - there);
        return (radians_32 << 12) / step_32;
    }
    uint64_t total = s->cosine + other;
    uint64_t rise = total && (outwards || 2 * x > step) ? x * along / total : 0;
    return ((s->cosine + rise) << 12) / s->hypotenuse;
}

static uint64_t finite_slope(const scaled *s, uint64_t step_32) /* 2^-12 */
{
    uint64_t x = magnitude(s->f2) < s->hypotenuse ? magnitude(s->f2) : s->hypotenuse;
    uint64_t inward = chord(s, x, step_32, false), outward = chord(s, x, step_32, true);
    return root((inward * inward + outward * outward) / 2);
}

/* A deviation in 2^-unit over P, in radians times 2^32; exponent: of the covariance over that of the force. */
static uint64_t over_P(uint64_t value, uint64_t P, int unit, int exponent)
{
    int up = 62 - bits(value);
    return value ? shifted((value << up) / P, exponent + 32 - unit - up, LARGEST_STEP) : 0;
}

static uint32_t as_turn(uint64_t radians_32)
{
    return radians_32 >= TURN_TO_RAD ? UINT32_MAX : (uint32_t)times_32(radians_32, RAD_TO_TURN);
}

static void uncertainty(const tipforce_fixed_calibration *c, const scaled *s, tipforce_fixed_result *r)
{
    r->u_phi = r->u_theta = UINT32_MAX;
    if (s->hypotenuse == 0) {
        r->u_P = (int32_t)shifted(worst_deviation(c->K), c->half + TIPFORCE_FORCE_BITS - 15, INT32_MAX);
        return;
    }
    int64_t hypotenuse = (int64_t)s->hypotenuse, unit = (int64_t)1 << 27;
    int64_t n1 = divided(s->f1 * unit, hypotenuse), n3 = divided(s->f3 * unit, hypotenuse);
    int64_t f2 = magnitude(s->f2) < s->hypotenuse ? s->f2 : s->f2 < 0 ? -hypotenuse : hypotenuse;
    int64_t x = divided(f2 * unit, hypotenuse);
    int64_t g1 = -reduced(x * n1, 27), g3 = -reduced(x * n3, 27);
    uint64_t P = (s->hypotenuse + magnitude(s->f2)) / 2;
    P = s->hypotenuse > P ? s->hypotenuse : P;
    int exponent = c->half + TIPFORCE_FORCE_BITS + s->up; /* P is in 2^-(20 + up) N */
    r->u_P = (int32_t)shifted(deviation(c->K, n1, 0, n3), c->half + TIPFORCE_FORCE_BITS - 27, INT32_MAX);
    r->u_phi = as_turn(over_P(deviation(c->K, n3, 0, -n1), P, 27, exponent));
    uint64_t step_32 = over_P(deviation(c->K, g1, unit, g3), P, 27, exponent);
    int64_t slope = (int64_t)finite_slope(s, step_32 ? step_32 : 1u);
    if (!c->pull) {
        slope = -slope;
    }
    int64_t w1 = n3 * 4096 - slope * g1, w2 = -slope * unit, w3 = -n1 * 4096 - slope * g3; /* 2^-39 */
    uint64_t most = magnitude(w1) | magnitude(w2) | magnitude(w3);
    int down = bits(most) > 28 ? bits(most) - 28 : 0;
    uint64_t spread = deviation(c->K, reduced(w1, down), reduced(w2, down), reduced(w3, down));
    r->u_theta = as_turn(over_P(spread, P, 39 - down, exponent));
}

static int64_t miss_uncertainty(const tipforce_fixed_calibration *c, const scaled *s) /* 2^-20 N */
{
    if (s->hypotenuse == 0) {
        uint64_t own = c->K[3] > 0 ? root((uint64_t)c->K[3]) : 0;
        return (int64_t)shifted(worst_deviation(c->K) + own, c->half + TIPFORCE_FORCE_BITS - 15, INT32_MAX);
    }
    int64_t hypotenuse = (int64_t)s->hypotenuse, unit = (int64_t)1 << 27;
    int64_t n1 = divided(s->f1 * unit, hypotenuse), n3 = divided(s->f3 * unit, hypotenuse);
    uint64_t found = deviation(c->K, -n1, s->f2 < 0 ? -unit : unit, -n3);
    return (int64_t)shifted(found, c->half + TIPFORCE_FORCE_BITS - 27, INT32_MAX);
}

static uint8_t status_bits(const tipforce_fixed_calibration *c, const scaled *s, bool was_present,
                           const tipforce_fixed_result *r)
{
    unsigned found = 0;
    if (r->P >= (was_present ? c->off : c->on)) {
        found = TIPFORCE_CONTACT_PRESENT;
    }
    if (!(r->P >= c->off && r->u_theta <= RESOLVED) || (r->unknown & TIPFORCE_UNKNOWN_THETA)) {
        found |= TIPFORCE_THETA_UNRESOLVED;
    }
    if (r->miss > 0 && r->miss > 3 * miss_uncertainty(c, s) + r->P / 1000000) {
        found |= TIPFORCE_MISSES_TIP;
    }
    if (found == TIPFORCE_CONTACT_PRESENT && (uint32_t)r->theta - c->theta_min > c->pad_width) {
        found |= TIPFORCE_OUTSIDE_PAD;
    }
    return (uint8_t)found;
}

static bool forces(const tipforce_fixed_calibration *c, const int32_t units[TIPFORCE_GAUGES], const int32_t tare[3],
                   int32_t F[3])
{
    for (int k = 0; k < TIPFORCE_GAUGES; k++) {
        if (units[k] > TIPFORCE_UNITS_LIMIT || units[k] < -TIPFORCE_UNITS_LIMIT) {
            return false;
        }
    }
    for (int i = 0; i < 3; i++) {
        int64_t sum = -c->bias[i];
        for (int k = 0; k < TIPFORCE_GAUGES; k++) {
            sum += (int64_t)c->C[i][k] * units[k];
        }
        int64_t force = reduced(sum, c->shift) - tare[i];
        if (force >= FORCE_LIMIT || force <= -FORCE_LIMIT) {
            return false;
        }
        F[i] = (int32_t)force;
    }
    return true;
}

void tipforce_fixed_estimate(const tipforce_fixed_calibration *c, const int32_t units[TIPFORCE_GAUGES],
                             const int32_t tare[3], uint8_t early, bool was_present, tipforce_fixed_result *r)
{
    static const tipforce_fixed_result nothing = {{0, 0, 0}, 0, 0, 0, 0, 0, UINT32_MAX, UINT32_MAX, 0, 0};
    scaled s;
    int32_t F[3];
    *r = nothing;
    r->status = early;
    if (!(tipforce_unknown(early) & TIPFORCE_UNKNOWN_FORCE) && !forces(c, units, tare, F)) {
        r->status = (uint8_t)(early | TIPFORCE_SATURATED);
    }
    if (tipforce_unknown(r->status) & TIPFORCE_UNKNOWN_FORCE) {
        r->unknown = tipforce_unknown(r->status);
        return;
    }
    for (int i = 0; i < 3; i++) {
        r->F[i] = F[i];
    }
    if (r->F[0] == 0 && r->F[1] == 0 && r->F[2] == 0) {
        s.hypotenuse = 0;
        s.up = 0;
        s.f2 = 0;
        r->unknown |= TIPFORCE_UNKNOWN_PHI | TIPFORCE_UNKNOWN_THETA;
    } else {
        scale(&s, r->F);
        contact(&s, c->pull, r);
    }
    uncertainty(c, &s, r);
    r->status = (uint8_t)(early | status_bits(c, &s, was_present, r));
    r->unknown = (uint8_t)(r->unknown | tipforce_unknown(r->status));
}

int32_t tipforce_fixed_millinewtons(int32_t force)
{
    return (int32_t)reduced((int64_t)force * 1000, TIPFORCE_FORCE_BITS);
}

int32_t tipforce_fixed_centidegrees(int32_t angle_turn)
{
    int32_t found = (int32_t)reduced((int64_t)angle_turn * 36000, 32);
    return found == -18000 ? 18000 : found;
}
