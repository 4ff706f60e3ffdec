// What sampling does to each row, on a CUDA device: the functions of sampling.c.
//
// Each kernel gives the numbers of its reference in Python, to the bit. The modules of this
// folder start them. All tensors are contiguous and on one device. A kernel has one
// argument, a struct of 8-byte fields. Rows that are out of range stop the device, as an
// index of torch does. Every kernel is right for any number of threads and blocks.

typedef long long i64;
typedef unsigned long long u64;
typedef unsigned char u8;

#define LEAVES 16     // tensors that one launch reads
#define NEXT 0x9E3779B97F4A7C15ull // of _fingerprints
#define THREADS 1024  // of a block, at most

#define EACH(i, count) \
    for (i64 i = (i64)blockIdx.x * blockDim.x + threadIdx.x; i < (count); \
         i += (i64)gridDim.x * blockDim.x)

// A block counts something in parts, one for each thread; returns how many there were
// before the thread's part, and the sum in total.
static __device__ i64 counted_before(i64 own, i64 *counts, i64 *total)
{
    counts[threadIdx.x] = own;
    __syncthreads();
    if (threadIdx.x == 0) {
        i64 sum = 0;
        for (unsigned t = 0; t < blockDim.x; t++) {
            i64 count = counts[t];
            counts[t] = sum;
            sum += count;
        }
        *total = sum;
    }
    __syncthreads();
    return counts[threadIdx.x];
}

static __device__ i64 clamped(i64 place, i64 length)
{
    return place < 0 ? 0 : place >= length ? length - 1 : place;
}

// _fingerprints.matches: which rows have the states of their fingerprints.
struct StateMatches {
    i64 rows, length;
    const i64 *places;
    i64 leaves;
    const i64 *known;
    i64 upper;
    u8 *valid;
    const int *values[LEAVES];
    i64 widths[LEAVES];
    const i64 *weights[LEAVES];
};

extern "C" __global__ void state_matches(const StateMatches a)
{
    EACH(r, a.rows) {
        i64 place = a.places ? a.places[r] : r;
        if (place < 0 || place >= a.length)
            __trap();
        u64 left = (u64)a.known[place];
        for (i64 l = 0; l < a.leaves; l++) {
            const int *value = a.values[l] + place * a.widths[l];
            for (i64 c = 0; c < a.widths[l]; c++)
                left -= (u64)(i64)value[c] * (u64)a.weights[l][c];
        }
        a.valid[r] = ((i64)left >> 32) == a.upper;
    }
}

// BatchCheck, for batches without anything unusual: which rows have the scores of their
// states, and are followed by the next row of their window.
struct RowsFit {
    i64 rows, window;
    const i64 *known;
    i64 upper;
    const i64 *ids;
    i64 leaves, flags;
    u8 *valid;
    const int *states[LEAVES], *next[LEAVES];
    const i64 *weights[LEAVES];
    i64 widths[LEAVES];
    const u8 *flag[LEAVES];
};

extern "C" __global__ void rows_fit(const RowsFit a)
{
    EACH(r, a.rows) {
        bool is_last = (r + 1) % a.window == 0, fits = true;
        u64 state = 0, after = 0;
        for (i64 l = 0; l < a.leaves; l++) {
            const int *here = a.states[l] + r * a.widths[l];
            const int *there = a.next[l] + r * a.widths[l];
            for (i64 c = 0; c < a.widths[l]; c++) {
                state += (u64)(i64)here[c] * (u64)a.weights[l][c];
                after += (u64)(i64)there[c] * (u64)a.weights[l][c];
                fits &= is_last || there[c] == here[c + a.widths[l]];
            }
        }
        if (a.known)
            fits &= ((i64)((u64)a.known[r] - state - NEXT * after) >> 32) == a.upper;
        if (!is_last) {
            fits &= !a.ids || a.ids[r] == a.ids[r + 1];
            for (i64 f = 0; f < a.flags; f++)
                fits &= !a.flag[f][r];
        }
        a.valid[r] = fits;
    }
}

// draws.uninfluenced: whether the scores of a window are at most the limits, of which
// there is one for all entities or one for each.
struct Uninfluenced {
    i64 windows, window, entities;
    const float *scores, *limits;
    i64 step;
    u8 *is_free;
};

extern "C" __global__ void uninfluenced(const Uninfluenced a)
{
    EACH(i, a.windows * a.entities) {
        i64 n = i % a.entities, first = i / a.entities * a.window;
        bool found = true;
        for (i64 w = 0; w < a.window; w++)
            found &= a.scores[(first + w) * a.entities + n] <= a.limits[n * a.step];
        a.is_free[i] = found;
    }
}

// draws.draw_windows: the windows whose random numbers are the smallest.
struct ChosenWindows {
    i64 windows, count;
    const double *number;
    u8 *chosen;
};

extern "C" __global__ void chosen_windows(const ChosenWindows a)
{
    EACH(w, a.windows) {
        double own = a.number[w];
        i64 rank = 0;
        for (i64 i = 0; i < a.windows; i++)
            rank += a.number[i] < own || (a.number[i] == own && i < w);
        a.chosen[w] = rank < a.count;
    }
}

// draws.draw_batch_donors, after its random numbers were drawn. A block has one entity.
struct BatchDonors {
    i64 count, first, entities, window;
    const u8 *is_free, *chosen;
    const float *chance;
    double swap_prob;
    const double *share;
    i64 *listed, *rank; // [entities, count]
    i64 *donors;
    u8 *swapped;
    i64 *no_donor;
};

extern "C" __global__ void batch_donors(const BatchDonors a)
{
    __shared__ i64 counts[THREADS], total;
    __shared__ u64 missing;
    i64 n = blockIdx.x, drawn = a.count - a.first, free = 0;
    i64 part = (a.count + blockDim.x - 1) / blockDim.x;
    i64 begin = threadIdx.x * part;
    i64 end = begin + part < a.count ? begin + part : a.count;
    i64 *listed = a.listed + n * a.count, *rank = a.rank + n * a.count;
    if (threadIdx.x == 0)
        missing = 0;
    for (i64 b = begin; b < end; b++)
        free += a.is_free[b * a.entities + n] != 0;
    free = counted_before(free, counts, &total);
    for (i64 b = begin; b < end; b++) {
        if (a.is_free[b * a.entities + n])
            listed[free++] = b * a.window;
        rank[b] = free;
    }
    __syncthreads();
    for (i64 c = threadIdx.x; c < drawn; c += blockDim.x) {
        i64 here = c * a.entities + n;
        u8 is_chosen = a.is_free[(a.first + c) * a.entities + n] != 0;
        i64 place = (i64)(a.share[n * drawn + c] * (double)(total - 1)) + 1;
        place += place >= rank[a.first + c]; // not the window itself
        a.donors[here] = place <= total ? listed[place - 1] : 0;
        if (a.chosen)
            is_chosen &= a.chosen[c];
        if (a.chance)
            is_chosen &= a.chance[n * drawn + c] < (float)a.swap_prob;
        a.swapped[here] = is_chosen && total > 1;
        if (is_chosen && total <= 1)
            atomicAdd(&missing, (u64)1);
    }
    __syncthreads();
    if (threadIdx.x == 0)
        a.no_donor[n] = (i64)missing;
}

// draws.draw_buffer_donors, after its random numbers were drawn.
struct BufferDonors {
    i64 drawn, entities;
    const u8 *is_free, *chosen;
    const float *chance;
    double swap_prob;
    const double *share;
    const i64 *offset, *size;
    i64 length, is_short;
    const void *starts;
    i64 *donors;
    u8 *swapped;
    i64 *no_donor; // zero
};

extern "C" __global__ void buffer_donors(const BufferDonors a)
{
    EACH(here, a.drawn * a.entities) {
        i64 c = here / a.entities, n = here % a.entities;
        u8 is_chosen = a.is_free[here] != 0;
        i64 place = (i64)(a.share[here] * (double)a.size[n]) + a.offset[n];
        place = clamped(place, a.length);
        a.donors[here] = a.is_short ? (i64)((const int *)a.starts)[place]
                                    : ((const i64 *)a.starts)[place];
        if (a.chosen)
            is_chosen &= a.chosen[c];
        if (a.chance)
            is_chosen &= a.chance[n * a.drawn + c] < (float)a.swap_prob;
        a.swapped[here] = is_chosen && a.size[n] > 0;
        if (is_chosen && a.size[n] <= 0)
            atomicAdd((u64 *)a.no_donor + n, (u64)1);
    }
}

// HindsightGoal.generate_parameters, after its random numbers were drawn. One block.
struct HindsightSources {
    i64 rows;
    const u8 *flags;
    const double *chance, *pick;
    double future, random, counterfactual;
    i64 *order, *source;
};

extern "C" __global__ void hindsight_sources(const HindsightSources a)
{
    __shared__ i64 counts[THREADS], total;
    i64 part = (a.rows + blockDim.x - 1) / blockDim.x, before = 0;
    i64 begin = threadIdx.x * part;
    i64 end = begin + part < a.rows ? begin + part : a.rows;
    for (i64 r = begin; r < end; r++)
        before += a.flags[r] != 0;
    before = counted_before(before, counts, &total);
    for (i64 r = begin; r < end; r++) // counterfactual rows first
        if (a.flags[r])
            a.order[before++] = r;
        else
            a.order[total + r - before] = r;
    __syncthreads();
    for (i64 r = threadIdx.x; r < a.rows; r += blockDim.x) {
        bool is_flag = a.flags[r] != 0;
        double share = is_flag ? a.counterfactual : a.future + a.random;
        i64 among = total, first = 0;
        if (!(a.chance[r] < share)) {
            a.source[r] = r;
            continue;
        }
        if (!is_flag && a.future > 0 && (a.random <= 0 || a.chance[r] < a.future)) {
            a.source[r] = r + 2 * a.rows;
            continue;
        }
        if (a.random > 0 && !is_flag) {
            first = total;
            among = a.rows - total;
        }
        a.source[r] = a.order[(i64)(a.pick[r] * (double)among) + first] + a.rows;
    }
}

// Some columns of rows.
struct ReadColumns {
    i64 rows, length;
    const i64 *places, *columns;
    i64 read, width, size; // columns to read and there are, bytes of a value
    const char *source;
    char *out;
};

static __device__ void copy(char *to, const char *from, i64 size)
{
    if (size == 4)
        *(int *)to = *(const int *)from;
    else if (size == 8)
        *(i64 *)to = *(const i64 *)from;
    else
        for (i64 i = 0; i < size; i++)
            to[i] = from[i];
}

extern "C" __global__ void read_columns(const ReadColumns a)
{
    EACH(i, a.rows * a.read) {
        i64 r = i / a.read, place = a.places ? a.places[r] : r;
        if (place < 0 || place >= a.length)
            __trap();
        copy(a.out + i * a.size,
             a.source + (place * a.width + a.columns[i % a.read]) * a.size, a.size);
    }
}

// HindsightGoal: the goals of rows by their sources, and the goals that rows achieve.
struct RelabelRows {
    i64 rows, width, size; // columns of a goal, bytes of a value
    const i64 *source;
    const char *desired, *future, *values;
    i64 columns; // of values
    const i64 *column;
    char *goals, *achieved;
    u8 *relabeled;
};

extern "C" __global__ void relabel_rows(const RelabelRows a)
{
    EACH(i, a.rows * a.width) {
        i64 r = i / a.width, c = i % a.width, from = a.source[r];
        const char *column = a.values + a.column[c] * a.size;
        i64 step = a.columns * a.size;
        if (from < 0 || from >= (a.future ? 3 : 2) * a.rows)
            __trap();
        copy(a.achieved + i * a.size, column + r * step, a.size);
        const char *goal = a.desired + (from * a.width + c) * a.size;
        if (from >= 2 * a.rows)
            goal = a.future + ((from - 2 * a.rows) * a.width + c) * a.size;
        else if (from >= a.rows)
            goal = column + (from - a.rows) * step;
        copy(a.goals + i * a.size, goal, a.size);
        if (c == 0)
            a.relabeled[r] = from >= a.rows;
    }
}

// swap.apply_swap: rows of leaves, in which entities are those of their donors. A value
// of a leaf belongs to the entity owner[column], or all of them to one.
struct SwapRows {
    i64 first, drawn, window, entities;
    const i64 *donors;
    const u8 *swapped;
    const char *own[LEAVES], *source[LEAVES];
    char *out[LEAVES];
    i64 length[LEAVES], width[LEAVES], size[LEAVES];
    const i64 *owner[LEAVES];
    i64 entity[LEAVES];
};

extern "C" __global__ void swap_rows(const SwapRows a)
{
    i64 l = blockIdx.y, width = a.width[l], size = a.size[l];
    EACH(i, (a.first + a.drawn * a.window) * width) {
        i64 column = i % width, row = i / width - a.first;
        i64 entity = a.owner[l] ? a.owner[l][column] : a.entity[l];
        const char *from = a.own[l] + i * size;
        if (row >= 0 && entity >= 0 && entity < a.entities) {
            i64 here = row / a.window * a.entities + entity;
            if (a.swapped[here]) {
                i64 donor = a.donors[here];
                if (donor < 0 || donor > a.length[l] - a.window)
                    __trap();
                from = a.source[l] + ((donor + row % a.window) * width + column) * size;
            }
        }
        copy(a.out[l] + i * size, from, size);
    }
}

// LateCheck.look: marks the tensors that have a bad value by NaN.
struct Look {
    double *found;
    const void *values[LEAVES];
    const u8 *where[LEAVES]; // the values that count
    i64 count[LEAVES], kind[LEAVES], place[LEAVES];
};

static __device__ bool is_bad(const void *values, i64 i, i64 kind)
{
    if (kind == 0 || kind == 3) { // float32: not finite, infinite
        unsigned bits = ((const unsigned *)values)[i] & 0x7fffffffu;
        return kind == 0 ? bits >= 0x7f800000u : bits == 0x7f800000u;
    }
    if (kind == 1 || kind == 4) { // float64
        u64 bits = ((const u64 *)values)[i] & 0x7fffffffffffffffull;
        return kind == 1 ? bits >= 0x7ff0000000000000ull : bits == 0x7ff0000000000000ull;
    }
    return (((const u8 *)values)[i] != 0) == (kind == 5); // bool: false is bad, true is
}

extern "C" __global__ void look(const Look a)
{
    i64 l = blockIdx.y;
    bool found = false;
    EACH(i, a.count[l])
        if (!a.where[l] || a.where[l][i])
            found |= is_bad(a.values[l], i, a.kind[l]);
    if (found) {
        u64 nan = 0x7ff8000000000000ull;
        ((volatile u64 *)a.found)[a.place[l]] = nan;
    }
}
