/* The compiled core: candump text to FRAME records, the PDOs of one latch to rows, their data to columns.

   These are the fast bodies of Python functions that do the same. `parse` leaves lines that are not of the plain
   forms below to host/logs/candump.py, which alone judges them; `join` is join_here of host/decoding/sample_rule.py,
   `extract` columns_of of host/decoding/sample_table.py; `rows` leaves what does not follow to samples/rows.py. Without
   this module everything works, slower. Limited API of Python 3.11: one build for all later versions. */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <stdint.h>
#include <string.h>
#ifdef __linux__
#include <errno.h>
#include <sys/socket.h>
#include <time.h>
#endif

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "FRAME is little-endian"
#endif

typedef unsigned char Byte;

enum { FRAME_BYTES = 24, DATA_BYTES = 8, CHANNELS = 256, DATE_BYTES = 19, NOT_HEX = 16 };

static const uint64_t SECOND_NS = 1000000000u;
static const uint32_t STANDARD_MASK = 0x7FF, EXTENDED_MASK = 0x1FFFFFFF;
static const uint32_t ERROR_FLAG = 0x20000000, EXTENDED_FLAG = 0x80000000;

static Byte HEX[256]; /* by character: its value, or NOT_HEX */

/* --- candump text ----------------------------------------------------------------------------- */

typedef struct {
    const Byte *names[CHANNELS + 1]; /* of the channels, each followed by a space; the last is their end */
    int channels, recent;
    const Byte *date; /* the one date that is known, and its time */
    uint64_t date_s;
    const Byte *stamp; /* the last one, as far as its point, and its seconds */
    Py_ssize_t stamp_size;
    uint64_t stamp_s;
    uint64_t last_ns; /* of the last line with a time */
    int deltas, timed;
} Text;

static const Byte *behind_spaces(const Byte *p, const Byte *end) {
    while (p < end && *p == ' ')
        p++;
    return p;
}

/* Read decimal digits, `most` at most; return what is behind them. */
static const Byte *decimal(const Byte *p, const Byte *end, int most, uint64_t *value) {
    uint64_t sum = 0;
    for (; most && p < end && *p >= '0' && *p <= '9'; p++, most--)
        sum = 10 * sum + (*p - '0');
    *value = sum;
    return p;
}

/* Read six decimal digits of the first eight characters, all at a time; return whether they are digits. */
static int six_digits(const Byte *p, uint64_t *value) {
    const uint64_t high = 0xF0F0F0F0F0F0F0F0u, zeros = 0x3030303030303030u, six = 0x0606060606060606u;
    uint64_t text;
    memcpy(&text, p, sizeof text);
    text = text << 16 | 0x3030; /* two zeros, which are the leading digits */
    if ((text & high) != zeros || ((text + six) & high) != zeros)
        return 0;
    text = (text & ~high) * (10 * 256 + 1) >> 8; /* pairs, then fours, then all */
    text = (text & 0x00FF00FF00FF00FFu) * (100 * 65536 + 1) >> 16;
    *value = (text & 0x0000FFFF0000FFFFu) * (10000 * ((uint64_t)1 << 32) + 1) >> 32;
    return 1;
}

/* Read "(seconds.fraction)"; return what is behind it, NULL for any other stamp. */
static const Byte *read_stamp(Text *text, const Byte *p, const Byte *end, uint64_t *t_ns) {
    uint64_t seconds, fraction;
    int is_date = 0;
    const Byte *start = p + 1;
    if (text->stamp_size && end - p > text->stamp_size && !memcmp(p, text->stamp, (size_t)text->stamp_size)) {
        seconds = text->stamp_s; /* those of the line before */
        p += text->stamp_size;
    } else {
        is_date = text->date && end - p > DATE_BYTES && !memcmp(start, text->date, DATE_BYTES);
        p = is_date ? start + DATE_BYTES : decimal(start, end, 10, &seconds);
        if (is_date)
            seconds = text->date_s;
        if (p == start || p >= end || *p != '.')
            return NULL;
        p++;
        if (!is_date) {
            text->stamp = start - 1;
            text->stamp_size = p - text->stamp;
            text->stamp_s = seconds;
        }
    }
    start = p;
    if (end - p >= 8 && p[6] == ')' && six_digits(p, &fraction))
        p += 6;
    else
        p = decimal(start, end, 9, &fraction);
    if (p - start == 6)
        fraction *= 1000;
    else if (p - start != 9 || is_date)
        return NULL;
    *t_ns = seconds * SECOND_NS + fraction; /* below 1e19: fits */
    if (*t_ns > INT64_MAX || p >= end || *p != ')')
        return NULL;
    if (text->deltas)
        *t_ns += text->last_ns;
    return *t_ns > INT64_MAX ? NULL : p + 1;
}

/* Read a channel's name and the spaces behind it; return what is behind them, NULL for another name. */
static const Byte *read_name(Text *text, const Byte *p, const Byte *end) {
    for (int tried = -1; tried < text->channels; tried++) {
        int k = tried < 0 ? text->recent : tried;
        if (k < text->channels) {
            Py_ssize_t size = text->names[k + 1] - text->names[k];
            if (size <= end - p && !memcmp(p, text->names[k], (size_t)size)) {
                text->recent = k;
                return behind_spaces(p + size, end);
            }
        }
    }
    return NULL;
}

/* Read an identifier of 3 or 8 digits; return what is behind it, NULL for any other. */
static const Byte *read_identifier(const Byte *p, const Byte *end, uint32_t *can_id) {
    const Byte *start = p;
    uint32_t id = 0;
    for (; p < end && p - start < 9 && HEX[*p] != NOT_HEX; p++)
        id = id << 4 | HEX[*p];
    if (p - start == 3 && id <= STANDARD_MASK)
        *can_id = id;
    else if (p - start == 8 && id <= (ERROR_FLAG | EXTENDED_MASK))
        *can_id = id & ERROR_FLAG ? id : id | EXTENDED_FLAG;
    else
        return NULL;
    return p;
}

/* Read pairs of digits, `gap` spaces between them; return how many, -1 for more than eight or half a pair. */
static int read_data(const Byte **at, const Byte *end, int gap, Byte *data) {
    const Byte *p = *at;
    int count = 0;
    while (end - p >= 2 && HEX[p[0]] != NOT_HEX) {
        if (count == DATA_BYTES || HEX[p[1]] == NOT_HEX)
            return -1;
        data[count++] = (Byte)(HEX[p[0]] << 4 | HEX[p[1]]);
        p += 2;
        if (gap && p < end && *p++ != ' ')
            return -1;
    }
    *at = p;
    return count;
}

/* Store the frame of a line; return 0, and store nothing, for a line that the Python parser has to judge. */
static int read_line(Text *text, const Byte *p, const Byte *end, Byte *frame) {
    while (end > p && (end[-1] == ' ' || end[-1] == '\r'))
        end--;
    int indented = p < end && *p == ' ', timed = 0, sent = 0, way = 0, length, told;
    uint64_t t_ns = 0;
    uint32_t can_id;
    Byte data[DATA_BYTES] = {0};
    p = behind_spaces(p, end);
    if (p < end && *p == '(') {
        const Byte *stamp = read_stamp(text, p, end, &t_ns);
        if (!stamp || stamp == end || *stamp != ' ')
            return 0;
        p = behind_spaces(stamp, end);
        timed = 1;
    }
    if (!(p = read_name(text, p, end)))
        return 0;
    if (end - p > 7 && (*p == 'R' || *p == 'T')) { /* candump -x */
        if (p[1] != 'X' || memcmp(p + 2, " - - ", 5))
            return 0;
        way = 1;
        sent = *p == 'T';
        p = behind_spaces(p + 7, end);
    }
    if (!(p = read_identifier(p, end, &can_id)) || p == end)
        return 0;
    if (*p == '#' && timed && !indented && !way) { /* the log format */
        p++;
        length = told = read_data(&p, end, 0, data);
        if (p < end && *p == ' ') { /* python-can's R or T */
            p = behind_spaces(p, end);
            sent = p < end && *p == 'T';
            if (p < end && (*p == 'R' || *p == 'T'))
                p++;
        }
    } else { /* the screen format */
        if (*p != ' ')
            return 0;
        p = behind_spaces(p, end);
        if (end - p < 3 || p[0] != '[' || p[1] < '0' || p[1] > '8' || p[2] != ']')
            return 0;
        told = p[1] - '0';
        p = behind_spaces(p + 3, end);
        length = read_data(&p, end, 1, data);
    }
    if (p != end || length != told || length < 0)
        return 0;
    memcpy(frame, &t_ns, 8);
    memcpy(frame + 8, &can_id, 4);
    frame[12] = (Byte)length;
    frame[13] = (Byte)text->recent;
    frame[14] = (Byte)sent;
    frame[15] = 0;
    memcpy(frame + 16, data, DATA_BYTES);
    if (timed)
        text->last_ns = t_ns;
    else
        text->timed = 0;
    return 1;
}

/* Set the channels from their names, each followed by a space; return 0 if there are too many. */
static int set_names(Text *text, const Byte *names, Py_ssize_t size) {
    const Byte *end = names + size;
    text->channels = text->recent = 0;
    text->names[0] = names;
    while (names < end && (names = memchr(names, ' ', (size_t)(end - names)))) {
        if (text->channels == CHANNELS)
            return 0;
        text->names[++text->channels] = ++names;
    }
    return 1;
}

PyDoc_STRVAR(parse_doc,
"parse(text, begin, end, room, count, names, last_ns, deltas, date, date_s)\n"
"-> (place, count, lines, last_ns, timed)\n\n"
"Store the frames of the lines text[begin:end] in ``room``, FRAME (n,), behind the first ``count``, up to the first\n"
"line that is not plain, or until ``room`` is full. Return the place behind the last line read, the frames in\n"
"``room``, the number of lines, the time of the last one, and whether all had a time. ``names``: of the channels,\n"
"each followed by a space; ``date``: the one that is known, or empty, and its seconds since 1970.");

static PyObject *parse(PyObject *module, PyObject *args) {
    Py_buffer text, room, names, date;
    Py_ssize_t begin, end, count;
    unsigned long long last_ns, date_s;
    Text state = {.timed = 1};
    PyObject *found = NULL;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*nnw*ny*Kpy*K", &text, &begin, &end, &room, &count, &names, &last_ns, &state.deltas,
                          &date, &date_s))
        return NULL;
    Py_ssize_t most = room.len / FRAME_BYTES, lines = 0;
    if (begin < 0 || end < begin || end > text.len || count < 0 || count > most ||
        (date.len && date.len != DATE_BYTES) || last_ns > INT64_MAX || date_s > 10 * SECOND_NS ||
        !set_names(&state, names.buf, names.len)) {
        PyErr_SetString(PyExc_ValueError, "parse: arguments");
        goto done;
    }
    state.date = date.len ? date.buf : NULL;
    state.date_s = date_s;
    state.last_ns = last_ns;
    const Byte *start = text.buf, *p = start + begin, *last = start + end;
    Byte *frames = room.buf;
    Py_BEGIN_ALLOW_THREADS
    while (p < last && count < most) {
        const Byte *line_end = memchr(p, '\n', (size_t)(last - p));
        if (!read_line(&state, p, line_end ? line_end : last, frames + count * FRAME_BYTES))
            break;
        count++;
        lines++;
        p = line_end ? line_end + 1 : last;
    }
    Py_END_ALLOW_THREADS
    found = Py_BuildValue("nnnKi", (Py_ssize_t)(p - start), count, lines, (unsigned long long)state.last_ns,
                          state.timed);
done:
    PyBuffer_Release(&text);
    PyBuffer_Release(&room);
    PyBuffer_Release(&names);
    PyBuffer_Release(&date);
    return found;
}

/* --- rows of samples -------------------------------------------------------------------------- */

enum { NO_COUNTER = -1, SAMPLES = 256, ORDER = 0, ROW, FIRST, COUNTER, HELD, HELD_NUMBER, COLUMNS, MESSAGES = 256 };

static const int64_t MOST_FRAMES = (int64_t)1 << 60;

typedef struct { /* SLOT of sample_rule.py: a message of a node */
    uint32_t sender, group;
    int16_t shift, mask; /* of the counter, shift -1 for none */
    Byte message, length, cyclic, used;
    uint16_t key, modulus;
} Slot;

typedef struct { /* the frames of a slot in complete rows; -1 for no counter that shows losses */
    int64_t frames, first, last, lost;
} Count;

typedef struct { /* the last row of a sender, and its last frame that follows SYNC */
    int64_t row, t_ns, number;
    int known, counter, message;
    Byte events[MESSAGES / 8]; /* the other messages in the row */
} Last;

typedef struct { /* a decoded frame: its index and slot, and the decoded frame with which its row begins */
    int64_t frame, number, start;
    uint32_t slot;
    int counter;
} Decoded;

typedef struct {
    const Byte *frames;
    const uint32_t *slots;
    const Slot *layouts;
    const int64_t *held_number;
    int64_t *work[COLUMNS], *ends; /* the latter by group */
    int64_t *seen, *too_short; /* by slot */
    Count *counts;
    Py_ssize_t count, kinds, held;
    int64_t number, gap_ns, gap_frames;
} Join;

static int64_t time_of(const Byte *frame) {
    int64_t t_ns;
    memcpy(&t_ns, frame, sizeof t_ns);
    return t_ns;
}

static int near(int64_t a, int64_t b, int64_t gap) {
    uint64_t distance = a > b ? (uint64_t)a - (uint64_t)b : (uint64_t)b - (uint64_t)a;
    return distance <= (uint64_t)gap;
}

/* Return the row of a frame that would begin the row `row`: SampleRule.row of sample_rule.py. */
static int64_t row_of(const Join *job, Last *last, const Slot *slot, int counter, int64_t t_ns, int64_t number,
                      int64_t row) {
    Byte *events = &last->events[slot->message / 8], event = (Byte)(1 << slot->message % 8);
    int joins = last->known && counter == last->counter && near(t_ns, last->t_ns, job->gap_ns) &&
                number - last->number <= job->gap_frames;
    if (counter == NO_COUNTER)
        return row;
    if (!slot->cyclic) {
        if (!joins || *events & event)
            return row;
        *events |= event;
        return last->row;
    }
    if (!joins || slot->message <= last->message) {
        last->row = row;
        memset(last->events, 0, sizeof last->events);
    }
    last->known = 1;
    last->counter = counter;
    last->message = slot->message;
    last->t_ns = t_ns;
    last->number = number;
    return last->row;
}

/* Give each frame that can be decoded its row; return how many there are, -1 for a slot out of range. */
static Py_ssize_t give_rows(Join *job, Last *last, Decoded *decoded) {
    Py_ssize_t found = 0;
    for (Py_ssize_t k = 0; k < job->count; k++) {
        const Byte *frame = job->frames + k * FRAME_BYTES;
        uint32_t kind = job->slots[k];
        if (kind >= (uint32_t)job->kinds)
            return -1;
        const Slot *slot = &job->layouts[kind];
        if (slot->sender >= (uint32_t)job->kinds || slot->group >= (uint32_t)job->kinds)
            return -1;
        if (!kind)
            continue;
        if (frame[12] < slot->length) {
            job->too_short[kind]++;
            continue;
        }
        if (!slot->used)
            continue;
        uint64_t word;
        memcpy(&word, frame + 16, sizeof word);
        int64_t number = found < job->held ? job->held_number[found] : job->number++;
        int counter = NO_COUNTER;
        if (slot->shift >= 0 && slot->shift < 64)
            counter = (int)(word >> slot->shift & (uint64_t)slot->mask);
        int64_t start = row_of(job, &last[slot->sender], slot, counter, time_of(frame), number, found);
        decoded[found++] = (Decoded){k, number, start, kind, counter};
    }
    return found;
}

/* Count a frame of a complete row: losses() of sample_rule.py. */
static void count_frame(Count *count, const Slot *slot, int64_t counter) {
    count->frames++;
    if (!slot->cyclic || !slot->modulus || (!counter && slot->modulus != SAMPLES)) /* 0 is no SYNC's latch */
        return;
    if (count->first < 0)
        count->first = counter;
    else {
        int64_t step = (counter - count->last) % slot->modulus;
        step += step < 0 ? slot->modulus : 0;
        count->lost += step > 1 ? step - 1 : 0;
    }
    count->last = counter;
}

/* Store the rows that no later frame can join: those before the first open one. */
static Py_ssize_t store_rows(Join *job, const Last *last, const Decoded *decoded, Py_ssize_t found, int is_last,
                             Py_ssize_t *held) {
    int64_t end = found, rows = 0, sum = 0;
    for (Py_ssize_t k = 0; !is_last && found && k < job->kinds; k++) {
        const Decoded *newest = &decoded[found - 1];
        int64_t now = time_of(job->frames + newest->frame * FRAME_BYTES);
        if (last[k].known && (now <= last[k].t_ns || near(now, last[k].t_ns, job->gap_ns)) &&
            newest->number - last[k].number < job->gap_frames && last[k].row < end)
            end = last[k].row;
    }
    int64_t *row = job->work[HELD]; /* of each decoded frame that begins one; the held frames follow at the end */
    for (Py_ssize_t k = 0; k < found; k++) {
        if (decoded[k].start == k && k < end) {
            job->work[FIRST][rows] = decoded[k].frame;
            job->work[COUNTER][rows] = decoded[k].counter;
            row[k] = rows++;
        }
        const Slot *slot = &job->layouts[decoded[k].slot];
        job->seen[decoded[k].slot] = 1;
        if (decoded[k].start < end) {
            job->ends[slot->group]++;
            count_frame(&job->counts[decoded[k].slot], slot, decoded[k].counter);
        }
    }
    for (Py_ssize_t k = 0; k < job->kinds; k++) { /* the place of a group's first frame, which grows to its end */
        int64_t frames = job->ends[k];
        job->ends[k] = sum;
        sum += frames;
    }
    for (Py_ssize_t k = 0; k < found; k++)
        if (decoded[k].start < end) {
            int64_t place = job->ends[job->layouts[decoded[k].slot].group]++;
            job->work[ORDER][place] = decoded[k].frame;
            job->work[ROW][place] = row[decoded[k].start];
        }
    *held = 0;
    for (Py_ssize_t k = 0; k < found; k++)
        if (decoded[k].start >= end) {
            job->work[HELD_NUMBER][*held] = decoded[k].number;
            job->work[HELD][(*held)++] = decoded[k].frame;
        }
    return rows;
}

/* Append a tuple of numbers. */
static int append(PyObject *list, int size, const int64_t *numbers) {
    PyObject *row = PyTuple_New(size);
    int failed = !row;
    for (int k = 0; k < size && !failed; k++) {
        PyObject *number = PyLong_FromLongLong(numbers[k]);
        failed = !number || PyTuple_SetItem(row, k, number) < 0;
    }
    failed = failed || PyList_Append(list, row) < 0;
    Py_XDECREF(row);
    return failed;
}

/* Return (rows, held, number, ends, counts, short) as join_here does; steals nothing. */
static PyObject *join_result(const Join *job, Py_ssize_t rows, Py_ssize_t held) {
    PyObject *ends = PyList_New(0), *counts = PyList_New(0), *too_short = PyList_New(0), *result = NULL;
    int failed = !ends || !counts || !too_short;
    int64_t low = 0;
    for (Py_ssize_t k = 0; k < job->kinds && !failed; k++) {
        const Count *count = &job->counts[k];
        if (job->ends[k] > low)
            failed = append(ends, 2, (int64_t[]){k, job->ends[k]});
        if (job->seen[k])
            failed |= append(counts, 5, (int64_t[]){k, count->frames, count->first, count->last, count->lost});
        if (job->too_short[k])
            failed |= append(too_short, 2, (int64_t[]){k, job->too_short[k]});
        low = job->ends[k];
    }
    if (!failed)
        result = Py_BuildValue("nnLOOO", rows, held, (long long)job->number, ends, counts, too_short);
    Py_XDECREF(ends);
    Py_XDECREF(counts);
    Py_XDECREF(too_short);
    return result;
}

PyDoc_STRVAR(join_doc,
"join(frames, slots, layouts, held_number, number, gap_ns, gap_frames, last, work)\n"
"-> (rows, held, number, ends, counts, short): see join_here of host/decoding/sample_rule.py.");

static PyObject *join(PyObject *module, PyObject *args) {
    Py_buffer frames, slots, layouts, held_number, work;
    Join job;
    long long number, gap_ns, gap_frames;
    int is_last;
    PyObject *result = NULL;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*y*LLLpw*", &frames, &slots, &layouts, &held_number, &number, &gap_ns,
                          &gap_frames, &is_last, &work))
        return NULL;
    job.frames = frames.buf;
    job.slots = slots.buf;
    job.layouts = layouts.buf;
    job.held_number = held_number.buf;
    job.count = frames.len / FRAME_BYTES;
    job.kinds = layouts.len / (Py_ssize_t)sizeof(Slot);
    job.held = held_number.len / 8;
    job.number = number;
    job.gap_ns = gap_ns;
    job.gap_frames = gap_frames;
    for (int k = 0; k < COLUMNS; k++)
        job.work[k] = (int64_t *)work.buf + k * job.count;
    size_t kinds = (size_t)job.kinds + 1;
    Last *last = PyMem_Calloc(kinds, sizeof *last);
    Decoded *decoded = PyMem_Malloc(((size_t)job.count + 1) * sizeof *decoded);
    job.ends = PyMem_Calloc(3 * kinds, sizeof *job.ends);
    job.counts = PyMem_Calloc(kinds, sizeof *job.counts);
    int fits = number < MOST_FRAMES && number > -MOST_FRAMES && gap_ns >= 0;
    fits = fits && slots.len == job.count * 4 && work.len == job.count * 8 * COLUMNS;
    for (Py_ssize_t k = 0; k < job.held; k++)
        fits = fits && job.held_number[k] < MOST_FRAMES && job.held_number[k] > -MOST_FRAMES;
    if (!last || !decoded || !job.ends || !job.counts)
        PyErr_NoMemory();
    else {
        job.seen = job.ends + kinds;
        job.too_short = job.seen + kinds;
        for (size_t k = 0; k < kinds; k++)
            job.counts[k].first = job.counts[k].last = -1;
        Py_ssize_t found = fits ? give_rows(&job, last, decoded) : -1, held = 0, rows;
        if (found < 0)
            PyErr_SetString(PyExc_ValueError, "join: arguments");
        else {
            rows = store_rows(&job, last, decoded, found, is_last, &held);
            result = join_result(&job, rows, held);
        }
    }
    PyMem_Free(last);
    PyMem_Free(decoded);
    PyMem_Free(job.ends);
    PyMem_Free(job.counts);
    PyBuffer_Release(&frames);
    PyBuffer_Release(&slots);
    PyBuffer_Release(&layouts);
    PyBuffer_Release(&held_number);
    PyBuffer_Release(&work);
    return result;
}

/* --- rows of a hand ----------------------------------------------------------------------------- */

enum { SYNC_ID = 0x80, STANDARD_IDS = 2048 };

typedef struct { /* the row of the last SYNC; by slot the answers to it, and whether there is one; Answer; slot_of */
    int64_t is_open, last, number, modulus, sync_ns, period_ns, gap_rows, awaited;
    double opened_s, wait_s;
    uint64_t slots[];
} Steady;

typedef struct { /* ANSWER of rows.py, by slot */
    uint64_t stale;
    int64_t length, shift;
} Answer;

/* Return the whole row (t_ns, number, words, reasons, states), of which all have the last two. */
static PyObject *whole_row(const Steady *state, Py_ssize_t slots, PyObject *reasons, PyObject *states) {
    PyObject *words = PyTuple_New(slots), *t_ns = PyLong_FromLongLong(state->sync_ns);
    PyObject *number = PyLong_FromLongLong(state->number), *row = NULL;
    int is_made = words && t_ns && number;
    for (Py_ssize_t k = 0; is_made && k < slots; k++) {
        PyObject *word = PyLong_FromUnsignedLongLong(state->slots[k]);
        is_made = word && !PyTuple_SetItem(words, k, word);
    }
    if (is_made)
        row = PyTuple_Pack(5, t_ns, number, words, reasons, states);
    Py_XDECREF(words);
    Py_XDECREF(t_ns);
    Py_XDECREF(number);
    return row;
}

/* Return whether every element of a list is True. */
static int all_true(PyObject *list) {
    Py_ssize_t count = PyList_Size(list), k = 0;
    while (k < count && PyList_GetItem(list, k) == Py_True)
        k++;
    return k == count;
}

/* Open the row of a SYNC; return whether it is the one that follows the last, whose row is whole. */
static int open_row(Steady *state, Py_ssize_t slots, const Byte *frame, int64_t most_gap_rows, double now_s) {
    int64_t number = frame[16], t_ns = time_of(frame);
    if (state->is_open || frame[12] != 1 || number != state->number % state->modulus + 1)
        return 0;
    state->is_open = 1;
    state->opened_s = now_s;
    state->last++;
    state->number = number;
    state->period_ns = (int64_t)((uint64_t)t_ns - (uint64_t)state->sync_ns);
    state->sync_ns = t_ns;
    state->gap_rows += state->gap_rows < most_gap_rows;
    state->awaited = slots;
    memset(state->slots + slots, 0, (size_t)slots * 8);
    return 1;
}

PyDoc_STRVAR(rows_doc,
"rows(frames, now_s, whole, (state, most_gap_rows, shown, other, reasons, states)) -> done\n\n"
"Process frames while each SYNC follows the last and each answer is to it; append whole rows to the list ``whole``.\n"
"Return the bytes before the first frame for which that is not so: see RowAssembler of samples/rows.py; all of them,\n"
"and one more, if the open row waits no longer. ``other`` is called with what is neither a SYNC nor an answer, and\n"
"may change ``shown``.");

static PyObject *rows(PyObject *module, PyObject *const *args, Py_ssize_t given) {
    Py_buffer frames, memory;
    PyObject *result = NULL;
    Py_ssize_t at = 0;
    (void)module;
    if (given != 4 || !PyList_Check(args[2]) || !PyTuple_Check(args[3]) || PyTuple_Size(args[3]) != 6 ||
        !PyList_Check(PyTuple_GetItem(args[3], 2))) {
        PyErr_SetString(PyExc_TypeError, "rows: arguments");
        return NULL;
    }
    PyObject *now_s = args[1], *whole = args[2], *shown = PyTuple_GetItem(args[3], 2);
    PyObject *other = PyTuple_GetItem(args[3], 3), *reasons = PyTuple_GetItem(args[3], 4);
    PyObject *states = PyTuple_GetItem(args[3], 5);
    long long most_gap_rows = PyLong_AsLongLong(PyTuple_GetItem(args[3], 1));
    double now = PyFloat_AsDouble(now_s);
    if (PyErr_Occurred() || PyObject_GetBuffer(args[0], &frames, PyBUF_SIMPLE) < 0)
        return NULL;
    if (PyObject_GetBuffer(PyTuple_GetItem(args[3], 0), &memory, PyBUF_WRITABLE) < 0) {
        PyBuffer_Release(&frames);
        return NULL;
    }
    const Py_ssize_t fixed = (Py_ssize_t)sizeof(Steady) + 2 * STANDARD_IDS, each = 16 + (Py_ssize_t)sizeof(Answer);
    Py_ssize_t count = frames.len / FRAME_BYTES, slots = (memory.len - fixed) / each;
    Steady *state = memory.buf;
    const Answer *answer_of = (const Answer *)(state->slots + 2 * slots);
    const uint16_t *slot_of = (const uint16_t *)(answer_of + slots); /* by identifier: the slot and 1 */
    int failed = memory.len != fixed + each * slots || memory.len < fixed || state->modulus < 2;
    if (failed)
        PyErr_SetString(PyExc_ValueError, "rows: arguments");
    for (int steady = !failed && all_true(shown); steady && !failed && at < count; at += steady) {
        const Byte *frame = (const Byte *)frames.buf + at * FRAME_BYTES;
        uint32_t can_id;
        uint64_t word;
        memcpy(&can_id, frame + 8, sizeof can_id);
        memcpy(&word, frame + 16, sizeof word);
        Py_ssize_t slot = can_id < STANDARD_IDS ? (Py_ssize_t)slot_of[can_id] - 1 : -1;
        if (slot >= slots) {
            PyErr_SetString(PyExc_ValueError, "rows: index");
            failed = 1;
        } else if (slot >= 0) {
            const Answer *answer = &answer_of[slot];
            if (frame[12] < answer->length)
                continue;
            int64_t counter = (int64_t)(word >> answer->shift & 0xFF);
            uint64_t *is_present = &state->slots[slots + slot];
            steady = state->is_open && counter == state->number && !*is_present && !(word & answer->stale);
            if (!steady)
                continue;
            state->slots[slot] = word;
            *is_present = 1;
            if (!--state->awaited) {
                PyObject *row = whole_row(state, slots, reasons, states);
                failed = !row || PyList_Append(whole, row) < 0;
                Py_XDECREF(row);
                state->is_open = 0;
            }
        } else if (can_id == SYNC_ID)
            steady = open_row(state, slots, frame, most_gap_rows, now);
        else {
            PyObject *none = PyObject_CallFunction(other, "LIiKO", (long long)time_of(frame), can_id, frame[12],
                                                   (unsigned long long)word, now_s);
            failed = !none;
            Py_XDECREF(none);
            if (!failed && !all_true(shown)) { /* what is not shown is not for this loop */
                at++;
                break;
            }
        }
    }
    if (!failed) {
        int is_over = at == count && state->is_open && now - state->opened_s >= state->wait_s;
        result = PyLong_FromSsize_t(at * FRAME_BYTES + is_over);
    }
    PyBuffer_Release(&frames);
    PyBuffer_Release(&memory);
    return result;
}

/* --- datagrams of a socket ---------------------------------------------------------------------- */

#ifdef __linux__
enum { STAMP = 35, DROPS = 40, BATCH = 256 }; /* SO_TIMESTAMPNS, SO_RXQ_OVFL; datagrams in a call */

/* Return the control message of a kind, NULL for none. */
static const void *control_of(struct msghdr *header, int kind) {
    struct cmsghdr *control = CMSG_FIRSTHDR(header);
    while (control && (control->cmsg_level != SOL_SOCKET || control->cmsg_type != kind))
        control = CMSG_NXTHDR(header, control);
    return control ? CMSG_DATA(control) : NULL;
}

/* Store a datagram, a struct can_frame, as a frame: bytes behind its data are not defined. */
static void store_frame(struct msghdr *header, Byte *frame) {
    const struct timespec *stamp = control_of(header, STAMP);
    struct timespec now;
    if (!stamp) {
        clock_gettime(CLOCK_REALTIME, &now);
        stamp = &now;
    }
    int64_t t_ns = (int64_t)stamp->tv_sec * (int64_t)SECOND_NS + stamp->tv_nsec;
    memcpy(frame, &t_ns, 8);
    memcpy(frame + 8, header->msg_iov->iov_base, 16);
    if (frame[12] > DATA_BYTES)
        frame[12] = DATA_BYTES;
    memset(frame + 13, 0, 3);
    frame[14] = header->msg_flags & MSG_DONTROUTE ? 1 : 0; /* SENT of frame_array.py */
    memset(frame + 16 + frame[12], 0, (size_t)(DATA_BYTES - frame[12]));
}

static Byte datagrams[BATCH][72]; /* struct can_frame and canfd_frame; the interpreter's lock guards them */
static Byte controls[BATCH][64];
static struct { unsigned short family; int interface; Byte rest[24]; } senders[BATCH]; /* struct sockaddr_can */
static struct iovec parts[BATCH];
static struct mmsghdr headers[BATCH];

/* Append a CAN FD frame, in the order of FdFrame of frame_block.py, to a list. */
static int append_fd(PyObject *list, Py_ssize_t row, int k) {
    Byte head[FRAME_BYTES];
    int64_t t_ns;
    uint32_t can_id;
    store_frame(&headers[k].msg_hdr, head);
    memcpy(&t_ns, head, sizeof t_ns);
    memcpy(&can_id, datagrams[k], sizeof can_id);
    int length = datagrams[k][4] < 64 ? datagrams[k][4] : 64;
    PyObject *frame = Py_BuildValue("nLIiy#iO", row, (long long)t_ns, can_id, (int)datagrams[k][5], datagrams[k] + 8,
                                    (Py_ssize_t)length, senders[k].interface, head[14] ? Py_True : Py_False);
    int failed = !frame || PyList_Append(list, frame) < 0;
    Py_XDECREF(frame);
    return failed;
}

PyDoc_STRVAR(receive_doc,
"receive(fd, room, interfaces, fd_frames) -> (count, classic, drops)\n\n"
"Read up to 256 waiting datagrams by recvmmsg, without giving up the interpreter: ``classic`` frames into\n"
"``room``, FRAME (n,), the numbers of their interfaces into ``interfaces``, i4 (n,), and CAN FD frames into the\n"
"list ``fd_frames``. ``drops``: what the kernel says with the last datagram, -1 for nothing. Raises OSError.");

static PyObject *receive(PyObject *module, PyObject *args) {
    int fd, failed = 0;
    Py_buffer room, interfaces;
    PyObject *fd_frames;
    Py_ssize_t classic = 0;
    long long drops = -1;
    (void)module;
    if (!PyArg_ParseTuple(args, "iw*w*O", &fd, &room, &interfaces, &fd_frames))
        return NULL;
    Py_ssize_t capacity = room.len / FRAME_BYTES < BATCH ? room.len / FRAME_BYTES : BATCH;
    int fits = interfaces.len >= capacity * 4 && PyList_Check(fd_frames);
    for (Py_ssize_t k = 0; k < capacity; k++) {
        struct msghdr *header = &headers[k].msg_hdr;
        parts[k].iov_base = datagrams[k], parts[k].iov_len = sizeof datagrams[k];
        header->msg_iov = &parts[k], header->msg_iovlen = 1;
        header->msg_name = &senders[k], header->msg_namelen = sizeof senders[k];
        header->msg_control = controls[k], header->msg_controllen = sizeof controls[k];
    }
    int count = fits ? recvmmsg(fd, headers, (unsigned)capacity, MSG_DONTWAIT, NULL) : -1;
    if (!fits)
        PyErr_SetString(PyExc_ValueError, "receive: arguments");
    else if (count < 0 && (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR))
        count = 0;
    else if (count < 0)
        PyErr_SetFromErrno(PyExc_OSError);
    for (int k = 0; k < count && !failed; k++) {
        struct msghdr *header = &headers[k].msg_hdr;
        const uint32_t *dropped = k + 1 == count ? control_of(header, DROPS) : NULL;
        if (dropped)
            drops = *dropped;
        if (headers[k].msg_len == 16) {
            memcpy((Byte *)interfaces.buf + 4 * classic, &senders[k].interface, 4);
            store_frame(header, (Byte *)room.buf + FRAME_BYTES * classic++);
        } else if (headers[k].msg_len == sizeof datagrams[k])
            failed = append_fd(fd_frames, classic, k);
    }
    PyBuffer_Release(&room);
    PyBuffer_Release(&interfaces);
    return count < 0 || failed ? NULL : Py_BuildValue("inL", count, classic, drops);
}
#endif

/* --- columns of signals ----------------------------------------------------------------------- */

enum { FLAG, INTEGER, NUMBER, REAL };

typedef struct { /* SIGNAL of sample_table.py */
    double scale, offset, divisor;
    uint64_t unknown;
    Byte start, bits, kind, size, is_signed, has_unknown, big_endian, spare;
} Signal;

static uint64_t swapped(uint64_t word) {
    uint64_t result = 0;
    for (int k = 0; k < 8; k++, word >>= 8)
        result = result << 8 | (word & 0xFF);
    return result;
}

static inline uint64_t raw_of(const Signal *signal, uint64_t word) {
    uint64_t sign = (uint64_t)1 << (signal->bits - 1);
    word = (signal->big_endian ? swapped(word) : word) >> signal->start & (sign | (sign - 1));
    return signal->is_signed ? (word ^ sign) - sign : word;
}

static double value_of(const Signal *signal, uint64_t raw) {
    double value;
    if (signal->kind == REAL) {
        float narrow;
        uint32_t low = (uint32_t)raw;
        memcpy(&value, &raw, sizeof value);
        memcpy(&narrow, &low, sizeof narrow);
        if (signal->bits == 32)
            value = narrow;
        return signal->scale == 1 && signal->offset == 0 ? value : value * signal->scale + signal->offset;
    }
    if (signal->has_unknown && raw == signal->unknown)
        return Py_NAN;
    value = signal->is_signed ? (double)(int64_t)raw : (double)raw;
    if (signal->divisor != 0)
        value /= signal->divisor;
    else if (signal->scale != 1)
        value *= signal->scale;
    return signal->offset != 0 ? value + signal->offset : value;
}

#define EACH_AT(place, type, value)            \
    for (Py_ssize_t k = 0; k < count; k++) {   \
        uint64_t raw = words[k] >> start;      \
        ((type *)out)[place] = (type)(value);  \
    }
#define EACH(type, value)                      \
    {                                          \
        if (row)                               \
            EACH_AT(row[k], type, value)       \
        else                                   \
            EACH_AT(k, type, value)            \
    }

/* Store the column of a signal: the value of words[k] at row[k], NULL: at k. */
static void extract_one(Signal signal, const uint64_t *words, const int64_t *row, Py_ssize_t count, void *out) {
    double divisor = signal.divisor;
    int start = signal.start, whole = signal.bits == 8 * signal.size && !signal.big_endian;
    int is_plain = signal.has_unknown && signal.is_signed && divisor != 0 && signal.offset == 0 && !signal.big_endian;
    int16_t unknown = (int16_t)signal.unknown;
    if (signal.kind == FLAG && !signal.big_endian)
        EACH(Byte, raw & 1)
    else if (signal.kind == INTEGER && whole && signal.size == 1)
        EACH(Byte, raw)
    else if (signal.kind == INTEGER && whole && signal.size == 2)
        EACH(uint16_t, raw)
    else if (signal.kind == NUMBER && is_plain && signal.bits == 16 && unknown == (int64_t)signal.unknown)
        EACH(double, (int16_t)raw == unknown ? Py_NAN : (int16_t)raw / divisor)
    else { /* any other, which is rarer */
        start = 0;
        if (signal.kind >= NUMBER)
            EACH(double, value_of(&signal, raw_of(&signal, raw)))
        else if (signal.size == 1)
            EACH(Byte, raw_of(&signal, raw))
        else if (signal.size == 2)
            EACH(uint16_t, raw_of(&signal, raw))
        else if (signal.size == 4)
            EACH(uint32_t, raw_of(&signal, raw))
        else
            EACH(uint64_t, raw_of(&signal, raw))
    }
}

PyDoc_STRVAR(extract_doc,
"extract(words, signals, out, row): store the columns of data words (k,), one after another, each as SIGNAL (m,)\n"
"says; ``row`` (k,): the place of each in its column, each once, or empty: in their order.");

static PyObject *extract(PyObject *module, PyObject *args) {
    Py_buffer words, signals, out, rows;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*w*y*", &words, &signals, &out, &rows))
        return NULL;
    Py_ssize_t count = words.len / 8, kinds = signals.len / (Py_ssize_t)sizeof(Signal), place = 0, in_order = 0;
    const Signal *signal = signals.buf;
    const int64_t *row = rows.len ? rows.buf : NULL;
    if (row && rows.len == count * 8) {
        while (in_order < count && row[in_order] == in_order)
            in_order++;
        for (Py_ssize_t k = in_order; k < count && kinds; k++)
            if (row[k] < 0 || row[k] >= count)
                kinds = 0;
        row = in_order == count ? NULL : row;
    } else if (row)
        kinds = 0;
    for (Py_ssize_t k = 0; k < kinds && place <= out.len; k++, signal++) {
        int size = signal->size, whole = size == 1 || size == 2 || size == 4 || size == 8;
        int fits = signal->bits >= 1 && signal->start + signal->bits <= 64 && (signal->kind < NUMBER || size == 8);
        if (!whole || !fits || count > (out.len - place) / size)
            break;
        if (((uintptr_t)out.buf + (size_t)place) % (size_t)size) /* not aligned */
            break;
        extract_one(*signal, words.buf, row, count, (Byte *)out.buf + place);
        place += count * size;
        if (k + 1 == kinds && place == out.len)
            place = -1;
    }
    PyBuffer_Release(&words);
    PyBuffer_Release(&signals);
    PyBuffer_Release(&out);
    PyBuffer_Release(&rows);
    if (place >= 0) {
        PyErr_SetString(PyExc_ValueError, "extract: arguments");
        return NULL;
    }
    Py_INCREF(Py_None);
    return Py_None;
}

/* --- module ----------------------------------------------------------------------------------- */

static PyMethodDef METHODS[] = {
    {"parse", parse, METH_VARARGS, parse_doc},
    {"join", join, METH_VARARGS, join_doc},
    {"rows", (PyCFunction)(void (*)(void))rows, METH_FASTCALL, rows_doc},
    {"extract", extract, METH_VARARGS, extract_doc},
#ifdef __linux__
    {"receive", receive, METH_VARARGS, receive_doc},
#endif
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_core", NULL, -1, METHODS, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__core(void) {
    memset(HEX, NOT_HEX, sizeof HEX);
    for (int k = 0; k < 16; k++) {
        HEX[(Byte)"0123456789abcdef"[k]] = (Byte)k;
        HEX[(Byte)"0123456789ABCDEF"[k]] = (Byte)k;
    }
    PyObject *module = PyModule_Create(&MODULE);
    if (module && PyModule_AddIntConstant(module, "INTERFACE", 7) < 0) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
