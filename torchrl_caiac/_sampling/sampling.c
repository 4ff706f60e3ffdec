/* What sampling does to each row, without one operation of torch after the other.
 *
 * Each function gives the numbers of its reference in Python, to the bit. The modules of
 * this folder call them. All tensors are contiguous and on the CPU. A function that
 * is given rows returns the place of the first one that is out of range, or GOOD.
 */
#include <stdint.h>
#include <string.h>

#define GOOD -1
#define NOT_FINITE -2
#define NO_WINDOWS -3
#define NEXT 0x9E3779B97F4A7C15u /* of _fingerprints */
#define LINE 64 /* bytes of a cache line */
#define AHEAD 8 /* how many rows before it is copied a donor is prefetched */
#define FAR 32 /* the same for rows that are copied whole */
#define MOST_FETCHED 4096 /* bytes of a row that are prefetched, at most */
#define TOGETHER 16 /* entities that are compared at a time */
#define LISTED 512 /* rows whose swaps are listed at a time */

/* Prefetches memory that is needed soon. */
static void fetch(const char *from, int64_t bytes)
{
    for (int64_t i = 0; i < bytes; i += LINE)
        __builtin_prefetch(from + i);
}

/* Copies bytes; a few of them without a function call. */
static inline void copy(char *to, const char *from, int64_t bytes)
{
    if (bytes > 256) {
        memcpy(to, from, (size_t)bytes);
        return;
    }
    for (; bytes >= 16; bytes -= 16, to += 16, from += 16)
        memcpy(to, from, 16);
    if (bytes >= 8) {
        memcpy(to, from, 8);
        bytes -= 8, to += 8, from += 8;
    }
    if (bytes >= 4) {
        memcpy(to, from, 4);
        bytes -= 4, to += 4, from += 4;
    }
    for (; bytes > 0; bytes--)
        *to++ = *from++;
}

/* The sum of numbers with weights; integers wrap around. */
static uint64_t weighted(const int32_t *value, const int64_t *weight, int64_t width)
{
    uint64_t sum = 0;
    for (int64_t c = 0; c < width; c++)
        sum += (uint64_t)(int64_t)value[c] * (uint64_t)weight[c];
    return sum;
}

/* Whether all float32 numbers are finite: their exponents are not all ones. */
int32_t all_finite(int64_t count, const int32_t *values)
{
    int32_t found = 0;
    for (int64_t i = 0; i < count; i++)
        found |= (values[i] & 0x7f800000) == 0x7f800000;
    return !found;
}

/* _fingerprints.state_hash: the hash of one leaf of each row. */
int64_t row_sums(int64_t rows, int64_t width, const int32_t *values,
                 const int64_t *weights, int64_t *sums)
{
    for (int64_t r = 0; r < rows; r++)
        sums[r] = (int64_t)weighted(values + r * width, weights, width);
    return GOOD;
}

/* Whether a row has the states of its fingerprint. */
static int is_of(uint64_t left, int64_t place, int64_t leaves,
                 const int32_t *const *values, const int64_t *widths,
                 const int64_t *const *weights, int64_t upper)
{
    for (int64_t l = 0; l < leaves; l++)
        left -= weighted(values[l] + place * widths[l], weights[l], widths[l]);
    return ((int64_t)left >> 32) == upper;
}

/* _fingerprints.matches: which rows have the states of their fingerprints. */
int64_t state_matches(int64_t rows, int64_t length, const int64_t *places,
                   int64_t leaves, const int32_t *const *values, const int64_t *widths,
                   const int64_t *const *weights, const int64_t *known,
                   int64_t upper, uint8_t *valid)
{
    for (int64_t r = 0; r < rows; r++) {
        int64_t place = places ? places[r] : r;
        if (place < 0 || place >= length)
            return r;
        if (places && r + AHEAD < rows && places[r + AHEAD] >= 0
            && places[r + AHEAD] < length)
            for (int64_t l = 0; l < leaves; l++)
                fetch((const char *)(values[l] + places[r + AHEAD] * widths[l]),
                      widths[l] * (int64_t)sizeof(int32_t));
        valid[r] = (uint8_t)is_of((uint64_t)known[place], place, leaves, values, widths,
                                  weights, upper);
    }
    return GOOD;
}

/* Lookahead: the first of some rows that differs from its row of a source. */
int64_t rows_equal(int64_t rows, int64_t length, const int64_t *places, int64_t bytes,
                   const char *own, const char *source)
{
    for (int64_t r = 0; r < rows; r++) {
        int64_t place = places[r];
        if (place < 0 || place >= length
            || memcmp(own + r * bytes, source + place * bytes, (size_t)bytes))
            return r;
    }
    return GOOD;
}

/* draws.draw_batch_donors, after its random numbers were drawn. */
int64_t batch_donors(int64_t count, int64_t first, int64_t entities, int64_t window,
                  const uint8_t *is_free, const uint8_t *chosen, const float *chance,
                  float swap_prob, const double *share, int64_t *listed,
                  int64_t *donors, uint8_t *swapped, int64_t *no_donor)
{
    int64_t drawn = count - first;
    for (int64_t n = 0; n < entities; n++) {
        int64_t total = 0, rank = 0, missing = 0;
        for (int64_t b = 0; b < count; b++)
            if (is_free[b * entities + n])
                listed[total++] = b * window;
        for (int64_t b = 0; b < first; b++)
            rank += is_free[b * entities + n] != 0;
        for (int64_t c = 0; c < drawn; c++) {
            int64_t here = c * entities + n, place;
            uint8_t is_chosen = is_free[(first + c) * entities + n] != 0;
            rank += is_chosen;
            place = (int64_t)(share[n * drawn + c] * (double)(total - 1)) + 1;
            place += place >= rank; /* not the window itself */
            donors[here] = place <= total ? listed[place - 1] : 0;
            if (chosen)
                is_chosen &= chosen[c] != 0;
            if (chance)
                is_chosen &= chance[n * drawn + c] < swap_prob;
            swapped[here] = is_chosen & (total > 1);
            missing += is_chosen & (total <= 1);
        }
        no_donor[n] = missing;
    }
    return GOOD;
}

/* draws.draw_buffer_donors, after its random numbers were drawn. */
int64_t buffer_donors(int64_t drawn, int64_t entities, const uint8_t *is_free,
                   const uint8_t *chosen, const float *chance, float swap_prob,
                   const double *share, const int64_t *offset, const int64_t *size,
                   int64_t length, int64_t is_short, const void *starts,
                   int64_t *donors, uint8_t *swapped, int64_t *no_donor)
{
    memset(no_donor, 0, (size_t)entities * sizeof(int64_t));
    for (int64_t c = 0; c < drawn; c++)
        for (int64_t n = 0; n < entities; n++) {
            int64_t here = c * entities + n;
            int64_t place = (int64_t)(share[here] * (double)size[n]) + offset[n];
            uint8_t is_chosen = is_free[here] != 0;
            place = place < 0 ? 0 : place >= length ? length - 1 : place;
            donors[here] = is_short ? ((const int32_t *)starts)[place]
                                    : ((const int64_t *)starts)[place];
            if (chosen)
                is_chosen &= chosen[c] != 0;
            if (chance)
                is_chosen &= chance[n * drawn + c] < swap_prob;
            swapped[here] = is_chosen & (size[n] > 0);
            no_donor[n] += is_chosen & (size[n] <= 0);
        }
    return GOOD;
}

/* HindsightGoal.generate_parameters, after its random numbers were drawn. */
int64_t hindsight_sources(int64_t rows, const uint8_t *flags, const double *chance,
                       const double *pick, double future, double random,
                       double counterfactual, int64_t *order, int64_t *source)
{
    int64_t size = 0, flagged = 0, last;
    for (int64_t r = 0; r < rows; r++)
        size += flags[r] != 0;
    last = size;
    for (int64_t r = 0; r < rows; r++) { /* counterfactual rows first */
        int64_t flag = flags[r] != 0, end[2] = {last, flagged};
        order[end[flag]] = r;
        flagged += flag;
        last += !flag;
    }
    /* Of real rows and of counterfactual ones: the share that is relabelled, and where
     * in the order the rows are that they draw among. Arrays instead of branches, which
     * the processor would mispredict. */
    const double share[2] = {future + random, counterfactual};
    const int64_t among[2] = {random > 0 ? rows - size : size, size};
    const int64_t from[2] = {random > 0 ? size : 0, 0};
    const double later = random > 0 ? future : future > 0 ? 2.0 : 0.0;
    for (int64_t r = 0; r < rows; r++) {
        int64_t flag = flags[r] != 0;
        int64_t place = (int64_t)(pick[r] * (double)among[flag]) + from[flag];
        int64_t found[2] = {order[place] + rows, r + 2 * rows};
        int64_t goal[2] = {r, found[(chance[r] < later) & !flag]};
        source[r] = goal[chance[r] < share[flag]];
    }
    return GOOD;
}

/* Some columns of rows: out[r] is made of runs of bytes of row places[r]. */
int64_t read_columns(int64_t rows, int64_t length, const int64_t *places,
                  int64_t row_bytes, int64_t runs, const int64_t *run_start, const int64_t *run_bytes,
                  const char *source, char *out)
{
    for (int64_t r = 0; r < rows; r++) {
        int64_t place = places ? places[r] : r;
        const char *from = source + place * row_bytes;
        if (place < 0 || place >= length)
            return r;
        if (places && r + AHEAD < rows)
            __builtin_prefetch(source + places[r + AHEAD] * row_bytes + run_start[0]);
        for (int64_t i = 0; i < runs; i++) {
            copy(out, from + run_start[i], run_bytes[i]);
            out += run_bytes[i];
        }
    }
    return GOOD;
}

/* The rows of all leaves at some places. A leaf has three numbers in the table: the
 * addresses of its source and of out, and its bytes per row. */
int64_t gather_rows(int64_t count, int64_t length, const int64_t *places, int64_t leaves,
                    const int64_t *table)
{
    for (int64_t r = 0; r < count; r++)
        if (places[r] < 0 || places[r] >= length)
            return r;
    for (; leaves > 0; leaves--, table += 3) {
        const char *source = (const char *)table[0];
        char *out = (char *)table[1];
        int64_t bytes = table[2];
        for (int64_t r = 0; r < count; r++, out += bytes) {
            if (r + FAR < count)
                fetch(source + places[r + FAR] * bytes, bytes < MOST_FETCHED ? bytes : MOST_FETCHED);
            copy(out, source + places[r] * bytes, bytes);
        }
    }
    return GOOD;
}

/* Some columns of rows that are some steps after others, at most the last one of their
 * trajectory; places is memory. */
int64_t read_ahead(int64_t rows, int64_t length, const int64_t *row, const int64_t *steps,
                   int64_t is_short, const void *left, int64_t row_bytes, int64_t runs,
                   const int64_t *run_start, const int64_t *run_bytes, const char *source,
                   int64_t *places, char *out)
{
    for (int64_t r = 0; r < rows; r++) {
        int64_t most, place = row[r];
        if (place < 0 || place >= length || steps[r] < 0)
            return r;
        most = is_short ? ((const int32_t *)left)[place] : ((const int64_t *)left)[place];
        place += steps[r] < most ? steps[r] : most;
        places[r] = place < length ? place : place - length;
    }
    return read_columns(rows, length, places, row_bytes, runs, run_start, run_bytes,
                        source, out);
}

/* HindsightGoal: the goals of rows by their sources, of hindsight_sources, and the goals
 * that the rows achieve, which are some columns of values. */
int64_t relabel_rows(int64_t rows, int64_t width, int64_t bytes, const int64_t *source,
                     const char *desired, const char *future, const char *values,
                     int64_t row_bytes, int64_t runs, const int64_t *run_start,
                     const int64_t *run_bytes, char *goals, char *achieved,
                     uint8_t *relabeled)
{
    int64_t size = width * bytes;
    const char *goal[3] = {desired, achieved, future};
    read_columns(rows, rows, 0, row_bytes, runs, run_start, run_bytes, values, achieved);
    for (int64_t r = 0; r < rows; r++) {
        int64_t from = source[r], kind = (from >= rows) + (from >= 2 * rows);
        if (from < 0 || from >= (future ? 3 : 2) * rows)
            return r;
        copy(goals + r * size, goal[kind] + (from - kind * rows) * size, size);
        relabeled[r] = kind > 0;
    }
    return GOOD;
}

/* A batch with other goals, from random numbers: hindsight_sources and relabel_rows, and
 * which rows are relabelled or counterfactual.
 *
 * Numbers: rows, width of a goal, bytes of a value, bytes of a row of values, runs; the
 * addresses of flags, random numbers (chance and pick), desired, future (or 0), values,
 * starts and lengths of the runs, memory (order and source), goals, achieved, relabeled
 * and changed. Shares: future, random, counterfactual.
 */
int64_t relabel_batch(const int64_t *number, const double *shares)
{
    int64_t rows = number[0], *order = (int64_t *)number[12], bad;
    const uint8_t *flags = (const uint8_t *)number[5];
    const double *chance = (const double *)number[6];
    uint8_t *relabeled = (uint8_t *)number[15], *changed = (uint8_t *)number[16];
    hindsight_sources(rows, flags, chance, chance + rows, shares[0], shares[1], shares[2],
                      order, order + rows);
    bad = relabel_rows(rows, number[1], number[2], order + rows, (const char *)number[7],
                       (const char *)number[8], (const char *)number[9], number[3],
                       number[4], (const int64_t *)number[10], (const int64_t *)number[11],
                       (char *)number[13], (char *)number[14], relabeled);
    for (int64_t r = 0; r < rows; r++)
        changed[r] = relabeled[r] | (flags[r] != 0);
    return bad;
}

/* WindowGoal, after its random numbers were drawn: the goals of the rows of windows, and
 * the steps to them. The last strategy whose bound is at most the chance of a window is
 * taken.
 *
 * Numbers: windows, rows in each, rows of the source, whether left is int32, strategies,
 * bytes of a row of the source and of a goal, runs; the addresses of rows, left, chance,
 * share, steps (each of these three or 0), source, starts and lengths of the runs,
 * memory, goals and the steps to them; the strategies.
 */
int64_t window_goals(const int64_t *number, const float *bound)
{
    int64_t windows = number[0], window = number[1], length = number[2];
    int64_t row_bytes = number[5], bytes = number[6];
    const int64_t *rows = (const int64_t *)number[8], *kind = number + 19;
    const void *left = (const void *)number[9];
    const float *chance = (const float *)number[10];
    const double *share = (const double *)number[11];
    const int64_t *steps = (const int64_t *)number[12];
    const char *source = (const char *)number[13];
    const int64_t *run_start = (const int64_t *)number[14];
    const int64_t *run_bytes = (const int64_t *)number[15];
    int64_t *places = (int64_t *)number[16], *ahead = (int64_t *)number[18];
    char *goals = (char *)number[17];
    for (int64_t b = 0; b < windows; b++) {
        const int64_t *row = rows + b * window;
        int64_t first = row[0], most, offset = 0, is_broken = 0;
        if (first < 0 || first >= length)
            return b * window;
        most = number[3] ? ((const int32_t *)left)[first] : ((const int64_t *)left)[first];
        most -= window - 1;
        for (int64_t w = 1; w < window; w++)
            is_broken |= row[w] != first + w - (first + w < length ? 0 : length);
        if (is_broken || most < 0)
            return NO_WINDOWS;
        for (int64_t k = 0; k < number[4]; k++) {
            int64_t drawn = most; /* 0, the last row */
            if (kind[k] == 1) /* uniform */
                drawn = (int64_t)(share[b] * (double)(most + 1));
            else if (kind[k] == 2 && steps[b] < most) /* geometric */
                drawn = steps[b];
            if (!chance || chance[b] >= bound[k])
                offset = drawn;
        }
        places[b] = row[window - 1] + offset;
        if (places[b] >= length)
            places[b] -= length;
        for (int64_t w = 0; w < window; w++)
            *ahead++ = offset + window - 1 - w;
    }
    for (int64_t b = 0; b < windows; b++) {
        const char *goal = goals;
        if (b + AHEAD < windows)
            __builtin_prefetch(source + places[b + AHEAD] * row_bytes + run_start[0]);
        for (int64_t i = 0; i < number[7]; i++, goals += run_bytes[i - 1])
            copy(goals, source + places[b] * row_bytes + run_start[i], run_bytes[i]);
        for (int64_t w = 1; w < window; w++, goals += bytes)
            copy(goals, goal, bytes);
    }
    return GOOD;
}

/* draws.uninfluenced: whether the scores of a window are at most the limits, of which
 * there is one for all entities or one for each. */
int64_t uninfluenced(int64_t windows, int64_t window, int64_t entities,
                     const float *scores, const float *limits, int64_t step,
                     uint8_t *is_free)
{
    int32_t above[TOGETHER];
    float limit[TOGETHER];
    for (int64_t begin = 0; begin < entities; begin += TOGETHER) {
        int64_t some = entities - begin < TOGETHER ? entities - begin : TOGETHER;
        for (int64_t n = 0; n < some; n++)
            limit[n] = limits[(begin + n) * step];
        for (int64_t b = 0; b < windows; b++) {
            const float *row = scores + b * window * entities + begin;
            memset(above, 0, sizeof(above));
            for (int64_t w = 0; w < window; w++, row += entities)
                for (int64_t n = 0; n < some; n++)
                    above[n] |= !(row[n] <= limit[n]); /* NaN is influence */
            for (int64_t n = 0; n < some; n++)
                is_free[b * entities + begin + n] = !above[n];
        }
    }
    return GOOD;
}

/* Copies a run of bytes of the donors to each window of a list. */
static void copy_run(int64_t count, const int64_t *listed, const int64_t *donors,
                     int64_t entities, int64_t window, int64_t row_bytes,
                     int64_t bytes, int64_t is_far, const char *source, char *out)
{
    int64_t ahead = window < AHEAD ? AHEAD / window : 1;
    for (int64_t i = 0; i < count; i++) {
        const char *from = source + donors[listed[i] * entities] * row_bytes;
        char *to = out + listed[i] * window * row_bytes;
        if (is_far && i + ahead < count) {
            const char *later = source + donors[listed[i + ahead] * entities] * row_bytes;
            for (int64_t w = 0; w < window; w++)
                fetch(later + w * row_bytes, bytes);
        }
        if (bytes == 4) /* a float, in one instruction */
            for (int64_t w = 0; w < window; w++)
                memcpy(to + w * row_bytes, from + w * row_bytes, 4);
        else if (bytes == 8)
            for (int64_t w = 0; w < window; w++)
                memcpy(to + w * row_bytes, from + w * row_bytes, 8);
        else
            for (int64_t w = 0; w < window; w++)
                copy(to + w * row_bytes, from + w * row_bytes, bytes);
    }
}

/* swap.apply_swap: the rows of all leaves, in which entities are those of their donors.
 *
 * A leaf has nine numbers in the table: the rows of its source, its bytes per row, its
 * runs of bytes, and the addresses of their entities, starts and lengths, of own, source
 * and out. Swaps are listed before they are applied, to avoid branch mispredictions.
 */
int64_t swap_rows(int64_t first, int64_t drawn, int64_t window, int64_t entities,
                  const int64_t *donors, const uint8_t *swapped, int64_t leaves,
                  const int64_t *table)
{
    int64_t listed[LISTED], length = leaves ? table[0] : 0;
    /* So few windows at a time that their rows stay in the cache. */
    int64_t most = window < LISTED ? LISTED / window : 1;
    for (int64_t l = 0; l < leaves; l++) {
        const int64_t *leaf = table + 9 * l;
        length = leaf[0] < length ? leaf[0] : length;
        memcpy((char *)leaf[8], (const char *)leaf[6], (size_t)(first * leaf[1]));
    }
    for (int64_t begin = 0; begin < drawn; begin += most) {
        int64_t end = begin + most < drawn ? begin + most : drawn;
        for (int64_t l = 0; l < leaves; l++) {
            const int64_t *leaf = table + 9 * l;
            int64_t start = (first + begin * window) * leaf[1];
            memcpy((char *)leaf[8] + start, (const char *)leaf[6] + start,
                   (size_t)((end - begin) * window * leaf[1]));
        }
        for (int64_t n = 0; n < entities; n++) {
            int64_t count = 0;
            for (int64_t c = begin; c < end; c++) {
                listed[count] = c;
                count += swapped[c * entities + n] != 0;
            }
            for (int64_t i = 0; i < count; i++) {
                int64_t here = listed[i] * entities + n;
                if (donors[here] < 0 || donors[here] > length - window)
                    return here;
            }
            for (int64_t l = 0; l < leaves; l++) {
                const int64_t *leaf = table + 9 * l;
                const int64_t *owner = (const int64_t *)leaf[3];
                const int64_t *start = (const int64_t *)leaf[4];
                const int64_t *bytes = (const int64_t *)leaf[5];
                for (int64_t i = 0; i < leaf[2]; i++)
                    if (owner[i] == n)
                        copy_run(count, listed, donors + n, entities, window, leaf[1],
                                 bytes[i], leaf[6] != leaf[7],
                                 (const char *)leaf[7] + start[i],
                                 (char *)leaf[8] + first * leaf[1] + start[i]);
            }
        }
    }
    return GOOD;
}

/* Whether a batch may be swapped: its scores are those of its states, and the rows of
 * its windows follow each other. BatchCheck, for batches without anything unusual.
 *
 * Numbers: rows, window, known, upper, ids, scores, how many scores, leaves, flags; for
 * each leaf the addresses of states, next states and weights, and their width; and the
 * address of each flag. Scores without fingerprints have to be finite.
 */
int64_t batch_fits(const int64_t *number)
{
    int64_t rows = number[0], window = number[1], leaves = number[7], flags = number[8];
    const int64_t *known = (const int64_t *)number[2], *ids = (const int64_t *)number[4];
    const int64_t *leaf = number + 9, *flag = leaf + 4 * leaves;
    if (!known && !all_finite(number[6], (const int32_t *)number[5]))
        return 0;
    for (int64_t start = 0; start < rows; start += window) {
        uint64_t after = 0;
        for (int64_t r = start + window - 1; r >= start; r--) {
            int64_t is_last = r == start + window - 1;
            uint64_t state = 0;
            for (int64_t l = 0; l < 4 * leaves; l += 4) {
                const int32_t *here = (const int32_t *)leaf[l];
                const int32_t *there = (const int32_t *)leaf[l + 1] + r * leaf[l + 3];
                const int64_t *weights = (const int64_t *)leaf[l + 2];
                here += r * leaf[l + 3];
                if (!is_last
                    && memcmp(there, here + leaf[l + 3],
                              (size_t)leaf[l + 3] * sizeof(int32_t)))
                    return 0;
                if (known && is_last)
                    after += weighted(there, weights, leaf[l + 3]);
                if (known)
                    state += weighted(here, weights, leaf[l + 3]);
            }
            if (known
                && ((int64_t)((uint64_t)known[r] - state - NEXT * after) >> 32)
                       != number[3])
                return 0;
            after = state;
            if (is_last)
                continue;
            if (ids && ids[r] != ids[r + 1])
                return 0;
            for (int64_t f = 0; f < flags; f++)
                if (((const uint8_t *)flag[f])[r])
                    return 0;
        }
    }
    return 1;
}

/* BufferDonors.verified: takes back swaps whose donors have other states than those of
 * their fingerprints. Returns how many. */
static int64_t take_back(int64_t drawn, int64_t entities, int64_t window,
                         const int64_t *donors, uint8_t *swapped, int64_t *no_donor,
                         const int64_t *known, int64_t length, int64_t upper,
                         int64_t leaves, const int32_t *const *values,
                         const int64_t *widths, const int64_t *const *weights)
{
    int64_t found = 0;
    for (int64_t here = 0; here < drawn * entities; here++) {
        int64_t donor = donors[here], later = here + AHEAD, is_good = 1;
        if (later < drawn * entities && swapped[later] && donors[later] >= 0
            && donors[later] < length)
            for (int64_t l = 0; l < leaves; l++)
                fetch((const char *)(values[l] + donors[later] * widths[l]),
                      widths[l] * (int64_t)sizeof(int32_t));
        if (!swapped[here] || donor < 0 || donor > length - window)
            continue;
        for (int64_t r = donor; r < donor + window && is_good; r += window - 1) {
            is_good = is_of((uint64_t)known[r], r, leaves, values, widths, weights, upper);
            if (window == 1)
                break;
        }
        if (!is_good) {
            swapped[here] = 0;
            no_donor[here % entities]++;
            found++;
        }
    }
    return found;
}

/* A batch with counterfactual windows, from random numbers: batch_donors or
 * buffer_donors, swap_rows and the flags that CounterfactualTransform adds. Returns the
 * first swap whose donor is out of range, NOT_FINITE if a state is not finite, or GOOD.
 *
 * Numbers: windows, first window that is drawn for, entities, window; the addresses of
 * is_free, order (a permutation of the windows, or 0), chance and share; how many
 * windows are chosen; the addresses of memory (listed, donors, no_donor; chosen,
 * swapped), of the counts that no_donor is added to, and of the flags; leaves and
 * states; the address of numbers about a storage that donors are from, or 0; for each
 * leaf what swap_rows knows; for each state its address and size. Lost is set to the
 * number of swaps that were taken back.
 *
 * About a storage: what buffer_donors knows of the eligible rows (the addresses of
 * offset and size, how many there are, whether they are int32, their address); the
 * address of the fingerprints, or 0; their number, the upper half of a fingerprint, the
 * leaves of states; the addresses of those, of their widths and of their weights.
 */
int64_t swap_batch(const int64_t *number, float swap_prob, int64_t *lost)
{
    int64_t count = number[0], first = number[1], entities = number[2];
    int64_t window = number[3], drawn = count - first, bad;
    const uint8_t *is_free = (const uint8_t *)number[4];
    const int64_t *order = (const int64_t *)number[5];
    const float *chance = (const float *)number[6];
    const double *share = (const double *)number[7];
    int64_t *listed = (int64_t *)number[9], *donors = listed + count;
    int64_t *no_donor = donors + drawn * entities, *total = (int64_t *)number[11];
    uint8_t *chosen = (uint8_t *)number[10], *swapped = chosen + drawn;
    uint8_t *chosen_flag = (uint8_t *)number[12], *swapped_flag = (uint8_t *)number[13];
    int64_t leaves = number[14], states = number[15];
    const int64_t *from = (const int64_t *)number[16], *leaf = number + 17;
    const int64_t *state = leaf + 9 * leaves;
    for (int64_t c = 0; c < drawn; c++)
        chosen[c] = !order || order[c] < number[8];
    *lost = 0;
    if (!from)
        batch_donors(count, first, entities, window, is_free, chosen, chance, swap_prob,
                     share, listed, donors, swapped, no_donor);
    else {
        buffer_donors(drawn, entities, is_free + first * entities, chosen, chance,
                      swap_prob, share, (const int64_t *)from[0], (const int64_t *)from[1],
                      from[2], from[3], (const void *)from[4], donors, swapped, no_donor);
        if (from[5])
            *lost = take_back(
                drawn, entities, window, donors, swapped, no_donor, (const int64_t *)from[5],
                from[6], from[7], from[8], (const int32_t *const *)from[9],
                (const int64_t *)from[10], (const int64_t *const *)from[11]);
    }
    bad = swap_rows(first * window, drawn, window, entities, donors, swapped, leaves, leaf);
    if (bad != GOOD)
        return bad;
    for (int64_t i = 0; i < states; i++)
        if (!all_finite(state[2 * i + 1], (const int32_t *)state[2 * i]))
            return NOT_FINITE;
    for (int64_t n = 0; n < entities; n++)
        total[n] += no_donor[n];
    memset(chosen_flag, 0, (size_t)(first * window));
    memset(swapped_flag, 0, (size_t)(first * window * entities));
    for (int64_t c = 0; c < drawn; c++)
        for (int64_t r = (first + c) * window; r < (first + c + 1) * window; r++) {
            chosen_flag[r] = chosen[c];
            copy((char *)swapped_flag + r * entities, (const char *)swapped + c * entities,
                 entities);
        }
    return GOOD;
}
