/* What sampling does to each row, without one operation of torch after the other.
 *
 * Each function gives the numbers of its reference in Python, to the bit; see
 * _sampling.py. All tensors are contiguous and on the CPU.
 */
#include <stdint.h>
#include <string.h>

#define AHEAD 8 /* rows whose donors are fetched before they are needed */

/* _fingerprints.matches: which rows have the states of their fingerprints. */
void state_matches(int64_t rows, const int64_t *places, int64_t leaves,
                   const int32_t *const *values, const int64_t *widths,
                   const int64_t *const *weights, const int64_t *known,
                   int64_t upper, uint8_t *valid)
{
    for (int64_t r = 0; r < rows; r++) {
        int64_t place = places ? places[r] : r;
        uint64_t left = (uint64_t)known[place];
        for (int64_t l = 0; l < leaves; l++) {
            const int32_t *value = values[l] + place * widths[l];
            const int64_t *weight = weights[l];
            uint64_t sum = 0;
            for (int64_t c = 0; c < widths[l]; c++)
                sum += (uint64_t)(int64_t)value[c] * (uint64_t)weight[c];
            left -= sum;
        }
        valid[r] = ((int64_t)left >> 32) == upper;
    }
}

/* draws.draw_batch_donors, after its random numbers were drawn. */
void batch_donors(int64_t count, int64_t first, int64_t entities, int64_t window,
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
}

/* swap.apply_swap: rows of a leaf, in which entities are those of their donors.
 *
 * An entity has runs of bytes in a row: run i is that of entity run_entity[i].
 */
void swap_rows(int64_t first, int64_t drawn, int64_t window, int64_t entities,
               const int64_t *donors, const uint8_t *swapped, int64_t row_bytes,
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
                    __builtin_prefetch(source + run_start[i]
                                       + donors[later + run_entity[i]] * row_bytes);
        }
        for (int64_t i = 0; i < runs; i++) {
            int64_t entity = run_entity[i];
            if (!is_swapped[entity])
                continue;
            const char *from = source + donors[c * entities + entity] * row_bytes;
            char *to = out + c * window * row_bytes;
            for (int64_t w = 0; w < window; w++)
                memcpy(to + w * row_bytes + run_start[i],
                       from + w * row_bytes + run_start[i], (size_t)run_bytes[i]);
        }
    }
}

/* Whether all float32 numbers are finite: their exponents are not all ones. */
int32_t all_finite(int64_t count, const int32_t *values)
{
    int32_t found = 0;
    for (int64_t i = 0; i < count; i++)
        found |= (values[i] & 0x7f800000) == 0x7f800000;
    return !found;
}
