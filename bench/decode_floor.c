// The floor for decoding a candump -L log of TPDO1 and TPDO2: one pass in C, built and run by bench/decode.py.
// Output: frames, decoded frames, sum of all first values that are not NaN, CPU seconds. Same work as the bulk decoder:
// each column of each message of each node is written, to buffers that start again as if someone had taken them.
#include <fcntl.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { BLOCK = 1 << 19, ROWS = 1 << 12, SLOTS = 256 };

struct slot {
    int64_t t_ns[ROWS];
    double value[3][ROWS];
    uint8_t flag[8][ROWS], counter[ROWS];
    unsigned rows;
};

static struct slot *slots[SLOTS]; // 0..127 gauges, 128..255 contact, by node-id
static int8_t digit_of[256];
static long frames, decoded, bad;
static double sum;

static int64_t decimal(const uint8_t *p, int digits, int *wrong) {
    int64_t value = 0;
    for (int k = 0; k < digits; k++) {
        *wrong |= (uint8_t)(p[k] - '0') > 9;
        value = 10 * value + (p[k] - '0');
    }
    return value;
}

static void keep(int64_t t_ns, unsigned id, const uint8_t *data) {
    unsigned number = (id & 0x7F) | (id >= 0x280 ? 0x80 : 0);
    struct slot *slot = slots[number];
    if (!slot) slot = slots[number] = calloc(1, sizeof *slot);
    unsigned row = slot->rows++ % ROWS;
    slot->t_ns[row] = t_ns;
    for (int k = 0; k < 3; k++) {
        int16_t raw = (int16_t)(data[2 * k] | data[2 * k + 1] << 8);
        double scale = id < 0x280 ? 10 : k ? 100 : 1000;
        slot->value[k][row] = raw == INT16_MIN ? NAN : raw / scale;
    }
    for (int k = 0; k < 8; k++) slot->flag[k][row] = data[6] >> k & 1;
    slot->counter[row] = data[7];
    if (!isnan(slot->value[0][row])) sum += slot->value[0][row];
    decoded++;
}

static void line(const uint8_t *p, const uint8_t *end) {
    int wrong = end - p < 22 || p[0] != '(' || p[11] != '.' || p[18] != ')';
    if (wrong) { bad++; return; }
    int64_t t_ns = decimal(p + 1, 10, &wrong) * 1000000000 + decimal(p + 12, 6, &wrong) * 1000;
    const uint8_t *id = memchr(p + 20, ' ', end - p - 20);
    const uint8_t *hash = id ? memchr(id, '#', end - id) : NULL;
    if (!hash) { bad++; return; }
    unsigned can_id = 0;
    for (id++; id < hash; id++) {
        wrong |= digit_of[*id] < 0;
        can_id = can_id << 4 | (digit_of[*id] & 15);
    }
    long digits = end - hash - 1;
    uint8_t data[8] = {0};
    wrong |= digits > 16 || digits & 1;
    for (int k = 0; !wrong && k < digits / 2; k++) {
        int high = digit_of[hash[1 + 2 * k]], low = digit_of[hash[2 + 2 * k]];
        wrong |= (high | low) < 0;
        data[k] = (uint8_t)(high << 4 | low);
    }
    if (wrong) { bad++; return; }
    frames++;
    if (digits == 16 && ((can_id > 0x180 && can_id < 0x200) || (can_id > 0x280 && can_id < 0x300)))
        keep(t_ns, can_id, data);
}

int main(int count, char **arguments) {
    static uint8_t text[2 * BLOCK];
    if (count != 2) return 2;
    memset(digit_of, -1, sizeof digit_of);
    for (int k = 0; k < 16; k++) digit_of[(int)"0123456789ABCDEF"[k]] = digit_of[(int)"0123456789abcdef"[k]] = (int8_t)k;
    clock_t started = clock();
    int file = open(arguments[1], O_RDONLY);
    long left = 0, got;
    while ((got = read(file, text + left, BLOCK)) > 0) {
        uint8_t *p = text, *stop = text + left + got, *end;
        for (; (end = memchr(p, '\n', stop - p)); p = end + 1) line(p, end);
        left = stop - p;
        memmove(text, p, left);
    }
    printf("%ld %ld %ld %.6f %.6f\n", frames, decoded, bad, sum, (double)(clock() - started) / CLOCKS_PER_SEC);
    return 0;
}
