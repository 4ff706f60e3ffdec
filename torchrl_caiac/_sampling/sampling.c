/* What sampling does to each row, without one operation of torch after the other.
 *
 * Each function gives the numbers of its reference in Python, to the bit; see
 * its Python modules. All tensors are contiguous and on the CPU. A function that
 * is given rows returns the place of the first one that is out of range, or GOOD.
 */
#include <stdint.h>
#include <string.h>

#define GOOD -1
#define NOT_FINITE -2
#define NEXT 0x9E3779B97F4A7C15u /* of _fingerprints */
#define LINE 64 /* bytes of a cache line */
#define AHEAD 8 /* rows whose donors are fetched before they are needed */

/* Fetches memory that is needed soon. */
static void fetch(const char *from, int64_t bytes)
{
    for (int64_t i = 0; i < bytes; i += LINE)
        __builtin_prefetch(from + i);
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

/* _fingerprints.matches: which rows have the states of their fingerprints. */
int64_t state_matches(int64_t rows, int64_t length, const int64_t *places,
                   int64_t leaves, const int32_t *const *values, const int64_t *widths,
                   const int64_t *const *weights, const int64_t *known,
                   int64_t upper, uint8_t *valid)
{
    for (int64_t r = 0; r < rows; r++) {
        int64_t place = places ? places[r] : r;
        uint64_t left;
        if (place < 0 || place >= length)
            return r;
        if (places && r + AHEAD < rows && places[r + AHEAD] >= 0
            && places[r + AHEAD] < length)
            for (int64_t l = 0; l < leaves; l++)
                fetch((const char *)(values[l] + places[r + AHEAD] * widths[l]),
                      widths[l] * (int64_t)sizeof(int32_t));
        left = (uint64_t)known[place];
        for (int64_t l = 0; l < leaves; l++)
            left -= weighted(values[l] + place * widths[l], weights[l], widths[l]);
        valid[r] = ((int64_t)left >> 32) == upper;
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
            rank += is_free[b * entities + n];
        for (int64_t c = 0; c < drawn; c++) {
            int64_t here = c * entities + n, place;
            uint8_t is_chosen = is_free[(first + c) * entities + n];
            rank += is_chosen;
            place = (int64_t)(share[n * drawn + c] * (double)(total - 1)) + 1;
            place += place >= rank; /* not the window itself */
            donors[here] = place <= total ? listed[place - 1] : 0;
            if (chosen)
                is_chosen &= chosen[c];
            if (chance)
                is_chosen &= chance[n * drawn + c] < swap_prob;
            swapped[here] = is_chosen && total > 1;
            missing += is_chosen && total <= 1;
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
            uint8_t is_chosen = is_free[here];
            place = place < 0 ? 0 : place >= length ? length - 1 : place;
            donors[here] = is_short ? ((const int32_t *)starts)[place]
                                    : ((const int64_t *)starts)[place];
            if (chosen)
                is_chosen &= chosen[c];
            if (chance)
                is_chosen &= chance[n * drawn + c] < swap_prob;
            swapped[here] = is_chosen && size[n] > 0;
            no_donor[n] += is_chosen && size[n] <= 0;
        }
    return GOOD;
}

/* HindsightGoal.generate_parameters, after its random numbers were drawn. */
int64_t hindsight_sources(int64_t rows, const uint8_t *flags, const double *chance,
                       const double *pick, double future, double random,
                       double counterfactual, int64_t *order, int64_t *source)
{
    int64_t size = 0, last;
    for (int64_t r = 0; r < rows; r++)
        if (flags[r])
            order[size++] = r; /* counterfactual rows first */
    last = size;
    for (int64_t r = 0; r < rows; r++)
        if (!flags[r])
            order[last++] = r;
    for (int64_t r = 0; r < rows; r++) {
        double share = flags[r] ? counterfactual : future + random;
        int64_t among = size, first = 0;
        if (!(chance[r] < share)) {
            source[r] = r;
            continue;
        }
        if (!flags[r] && future > 0 && (random <= 0 || chance[r] < future)) {
            source[r] = r + 2 * rows;
            continue;
        }
        if (random > 0 && !flags[r]) {
            first = size;
            among = rows - size;
        }
        source[r] = order[(int64_t)(pick[r] * (double)among) + first] + rows;
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
            memcpy(out, from + run_start[i], (size_t)run_bytes[i]);
            out += run_bytes[i];
        }
    }
    return GOOD;
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
    read_columns(rows, rows, 0, row_bytes, runs, run_start, run_bytes, values, achieved);
    for (int64_t r = 0; r < rows; r++) {
        int64_t from = source[r];
        const char *goal = desired + from * size;
        if (from < 0 || from >= (future ? 3 : 2) * rows)
            return r;
        if (from >= 2 * rows)
            goal = future + (from - 2 * rows) * size;
        else if (from >= rows)
            goal = achieved + (from - rows) * size;
        memcpy(goals + r * size, goal, (size_t)size);
        relabeled[r] = from >= rows;
    }
    return GOOD;
}

/* Rows of a leaf, in which entities are those of their donors.
 *
 * An entity has runs of bytes in a row: run i is that of entity run_entity[i].
 */
static int64_t swap_leaf(int64_t first, int64_t drawn, int64_t window, int64_t entities,
               int64_t length, const int64_t *donors, const uint8_t *swapped, int64_t row_bytes,
               int64_t runs, const int64_t *run_entity, const int64_t *run_start,
               const int64_t *run_bytes, const char *own, const char *source, char *out)
{
    memcpy(out, own, (size_t)((first + drawn * window) * row_bytes));
    out += first * row_bytes;
    for (int64_t c = 0; c < drawn; c++) {
        const uint8_t *is_swapped = swapped + c * entities;
        if (c + AHEAD < drawn) {
            int64_t later = (c + AHEAD) * entities;
            for (int64_t i = 0; i < runs; i++)
                if (swapped[later + run_entity[i]])
                    fetch(source + run_start[i]
                              + donors[later + run_entity[i]] * row_bytes,
                          run_bytes[i]);
        }
        for (int64_t i = 0; i < runs; i++) {
            int64_t entity = run_entity[i];
            if (!is_swapped[entity])
                continue;
            int64_t donor = donors[c * entities + entity];
            const char *from = source + donor * row_bytes;
            char *to = out + c * window * row_bytes;
            if (donor < 0 || donor > length - window)
                return c * entities + entity;
            for (int64_t w = 0; w < window; w++)
                memcpy(to + w * row_bytes + run_start[i],
                       from + w * row_bytes + run_start[i], (size_t)run_bytes[i]);
        }
    }
    return GOOD;
}

/* draws.uninfluenced: whether the scores of a window are at most the limits, of which
 * there is one for all entities or one for each. */
int64_t uninfluenced(int64_t windows, int64_t window, int64_t entities,
                     const float *scores, const float *limits, int64_t step,
                     uint8_t *is_free)
{
    for (int64_t b = 0; b < windows; b++)
        for (int64_t n = 0; n < entities; n++) {
            uint8_t found = 1;
            for (int64_t w = 0; w < window; w++)
                found &= scores[(b * window + w) * entities + n] <= limits[n * step];
            is_free[b * entities + n] = found;
        }
    return GOOD;
}

/* swap.apply_swap: the rows of all leaves.
 *
 * A leaf has nine numbers in the table: those of its source, its bytes a row, its runs,
 * and the addresses of their entities, starts and lengths, of own, source and out.
 */
int64_t swap_rows(int64_t first, int64_t drawn, int64_t window, int64_t entities,
                  const int64_t *donors, const uint8_t *swapped, int64_t leaves,
                  const int64_t *table)
{
    for (; leaves > 0; leaves--, table += 9) {
        int64_t bad = swap_leaf(
            first, drawn, window, entities, table[0], donors, swapped, table[1], table[2],
            (const int64_t *)table[3], (const int64_t *)table[4], (const int64_t *)table[5],
            (const char *)table[6], (const char *)table[7], (char *)table[8]);
        if (bad != GOOD)
            return bad;
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

/* A batch with counterfactual windows, from random numbers: batch_donors, swap_rows and
 * the flags that CounterfactualTransform adds. NOT_FINITE if a state is not.
 *
 * Numbers: windows, first window that is drawn for, entities, window; the addresses of
 * is_free, order (a permutation of the windows, or 0), chance and share; how many
 * windows are chosen; the addresses of memory (listed, donors, no_donor; chosen,
 * swapped), of the counts that no_donor is added to, and of the flags; leaves and
 * states; for each leaf what swap_rows knows; for each state its address and size.
 */
int64_t swap_batch(const int64_t *number, float swap_prob)
{
    int64_t count = number[0], first = number[1], entities = number[2];
    int64_t window = number[3], drawn = count - first;
    const int64_t *order = (const int64_t *)number[5];
    int64_t *listed = (int64_t *)number[9], *donors = listed + count;
    int64_t *no_donor = donors + drawn * entities, *total = (int64_t *)number[11];
    uint8_t *chosen = (uint8_t *)number[10], *swapped = chosen + drawn;
    uint8_t *chosen_flag = (uint8_t *)number[12], *swapped_flag = (uint8_t *)number[13];
    int64_t leaves = number[14], states = number[15];
    const int64_t *leaf = number + 16, *state = leaf + 9 * leaves;
    for (int64_t c = 0; c < drawn; c++)
        chosen[c] = !order || order[c] < number[8];
    batch_donors(count, first, entities, window, (const uint8_t *)number[4], chosen,
                 (const float *)number[6], swap_prob, (const double *)number[7], listed,
                 donors, swapped, no_donor);
    swap_rows(first * window, drawn, window, entities, donors, swapped, leaves, leaf);
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
            memcpy(swapped_flag + r * entities, swapped + c * entities, (size_t)entities);
        }
    return GOOD;
}
