// Common parts of the backward passes on matrices: a tile of samples, input gradients, weight gradients, and sums. The
// including file must declare the constants `upper_columns` and `lower_columns` (numbers of inputs of the upper layer, and of
// the layer below it, or 0 if the pass ends at the upper layer), `shares` and `lower_shares`, the size of `tile_in`, the push
// constants, `weights16` and `partials`.

const uint width8 = width / 8u;
const uint upper_columns8 = upper_columns / 8u;
const uint lower_columns8 = lower_columns / 8u;
// One additional uvec4 per row avoids bank conflicts.
const uint dz_stride = width8 + 1u;
const uint input_stride = upper_columns8 + 1u;
const uint lower_stride = lower_columns8 + 1u;
const uint longest_stride = input_stride > lower_stride ? input_stride : lower_stride;
const uint row_tiles = tile / m;
const uint column_tiles = width / n;
// Weight gradient: the subgroups form bands over neurons times shares of the inputs.
const uint bands = subgroups / shares;
const uint grad_rows = (width / m + bands - 1u) / bands;
const uint grad_columns = (upper_columns / n + shares - 1u) / shares;
const uint lower_bands = subgroups / lower_shares;
const uint lower_rows = (width / m + lower_bands - 1u) / lower_bands;
const uint lower_grad_columns = (lower_columns / n + lower_shares - 1u) / lower_shares;
// Whether tiles of the last band or share are outside the gradient. These are constants, so that drivers can remove the tests
// where no tile is outside.
const bool overhangs = bands * grad_rows * m > width || shares * grad_columns * n > upper_columns;
const bool lower_overhangs = lower_bands * lower_rows * m > width || lower_shares * lower_grad_columns * n > lower_columns;
const uint max_rows = grad_rows > lower_rows ? grad_rows : lower_rows;
const uint upper_tiles = grad_rows * grad_columns;
// Input gradient, which only hidden inputs have: the columns of tiles are distributed among the subgroups; if there are more
// subgroups than columns, the rows are divided into shares, too.
const uint row_shares = subgroups > column_tiles ? subgroups / column_tiles : 1u;
const uint input_rows = row_tiles / row_shares;
const uint input_columns = column_tiles * row_shares / subgroups;
// Sums over samples: an invocation sums one neuron, or several at regular distances, over one part of the rows.
const uint row_parts = gl_WorkGroupSize.x / width > 0u ? gl_WorkGroupSize.x / width : 1u;
const uint lane_neurons = (width + gl_WorkGroupSize.x - 1u) / gl_WorkGroupSize.x;
const uint scratch = 2u * gl_WorkGroupSize.x;
shared uvec4 tile_dz[tile * dz_stride > scratch ? tile * dz_stride : scratch];
shared uvec4 tile_in[INPUTS_SIZE];

SUM weight_gradient[upper_tiles + lower_rows * lower_grad_columns];
float bias_sum[lane_neurons];
float lower_bias_sum[lane_neurons];
// Maximum magnitude of a gradient in f16. A conversion of a larger number gives infinity on some devices and the maximum of f16
// on others.
float largest;
shared uint overflowed;

// Copies of rows to shared memory in parts, of which an invocation has one each. All loads of an invocation are issued before
// the first result is used; a loop would wait for each load.
#define PARTS(size) ((size) > 0u ? ((size) - 1u) / gl_WorkGroupSize.x + 1u : 1u)
#define IN_PART(e, size) ((size) > 0u && (size) % gl_WorkGroupSize.x == 0u || e < (size))
#define FETCH(parts, rows, at, size) \
    [[unroll]] for (uint i = 0u; i < PARTS(size); i++) { \
        uint e = gl_LocalInvocationIndex + i * gl_WorkGroupSize.x; \
        if (IN_PART(e, size)) parts[i] = rows[(at) + e]; \
    }
#define PLACE(parts, rows, columns8, stride, size) \
    [[unroll]] for (uint i = 0u; i < PARTS(size); i++) { \
        uint e = gl_LocalInvocationIndex + i * gl_WorkGroupSize.x; \
        if (IN_PART(e, size)) rows[e / (columns8) * (stride) + e % (columns8)] = parts[i]; \
    }
const uint dz_size = tile * width8;
const uint input_size = tile * upper_columns8;
const uint lower_size = tile * lower_columns8;

// Selects one neuron's number from the numbers of eight neurons.
float neuron_of(uvec4 packed, uint neuron) {
    vec2 pair = unpackHalf2x16(packed[(neuron & 7u) / 2u]);
    return (neuron & 1u) == 0u ? pair.x : pair.y;
}

// Adds an invocation's part of the dz in shared memory to its sums.
void add_dz(inout float sums[lane_neurons]) {
    uint part = gl_LocalInvocationIndex / width;
    [[unroll]] for (uint i = 0u; i < lane_neurons; i++) {
        uint neuron = gl_LocalInvocationIndex % width + i * gl_WorkGroupSize.x;
        if (part >= row_parts || neuron >= width) continue;
        for (uint row = part; row < tile; row += row_parts) {
            sums[i] += neuron_of(tile_dz[row * dz_stride + neuron / 8u], neuron);
        }
    }
}

void put(uint at, float value) {
    partials[at] = value + (push.accumulate != 0u ? partials[at] : 0.0);
}

// Adds each invocation's sums over the parts of the rows in their order and writes the results.
void put_neuron_sums(float sums[lane_neurons], uint at) {
    barrier();
    tile_dz[gl_LocalInvocationIndex].x = floatBitsToUint(sums[0]);
    barrier();
    [[unroll]] for (uint i = 0u; i < lane_neurons; i++) {
        uint neuron = gl_LocalInvocationIndex + i * gl_WorkGroupSize.x;
        float total = sums[i];
        for (uint part = 1u; part < row_parts; part++) total += uintBitsToFloat(tile_dz[part * width + neuron].x);
        if (neuron < width) put(at + neuron, total);
    }
}

// Position of a subgroup's tiles of an input gradient.
uint gradient_row(uint r) {
    return (gl_SubgroupID / column_tiles + r * row_shares) * m;
}

uint gradient_column(uint c) {
    return (gl_SubgroupID % column_tiles + c * subgroups) * n;
}

// A tile of the gradient of a layer's input, set to zero where the input is not positive. The input's f16 numbers begin at
// `on_at` in shared memory.
#ifdef F32_SUMS
GRADIENT where_on(SUM sum, uint on_at) {
    share_sums(sum);
    for (uint e = gl_SubgroupInvocationID; e < m * n; e += gl_SubgroupSize) {
        uint row = e / n, column = e % n, at = gl_SubgroupID * m * n + e;
        bool on = neuron_of(tile_in[on_at + row * dz_stride + column / 8u], column) > 0.0;
        sum_tile[at] = on ? sum_tile[at] : 0.0;
        largest = max(largest, abs(sum_tile[at]));
    }
    subgroupBarrier();
    coopMatLoad(sum, sum_tile, gl_SubgroupID * m * n, n, ROWS);
    return sum;
}
#else
// The order of elements may differ between component types, so the mask is applied to operands of equal type.
GRADIENT where_on(SUM sum, uint on_at) {
    SUM16 gradient = SUM16(sum), on;
    coopMatLoad(on, tile_in, on_at, dz_stride, ROWS);
    [[unroll]] for (uint i = 0u; i < gradient.length(); i++) {
        gradient[i] = on[i] > float16_t(0.0) ? gradient[i] : float16_t(0.0);
        largest = max(largest, abs(float(gradient[i])));
    }
    return gradient;
}
#endif

// Computes the gradient of a layer's input in a subgroup's tiles of a column from the dz and the input in shared memory.
// Weights are read once for all rows. The loop is not unrolled, because the operands of all steps and the sums of two layers
// together exceed the registers.
void input_gradient(uint weights_at, uint column, out GRADIENT gradient[input_rows]) {
    SUM sums[input_rows];
    [[unroll]] for (uint r = 0u; r < input_rows; r++) sums[r] = SUM(0.0);
    [[dont_unroll]] for (uint step = 0u; step < width / k; step++) {
        RIGHT weights;
        coopMatLoad(weights, weights16, (weights_at + step * k * width + column) / 8u, width8, ROWS);
        [[unroll]] for (uint r = 0u; r < input_rows; r++) {
            LEFT dz;
            coopMatLoad(dz, tile_dz, gradient_row(r) * dz_stride + step * k / 8u, dz_stride, ROWS);
            sums[r] = coopMatMulAdd(dz, weights, sums[r]);
        }
    }
    [[unroll]] for (uint r = 0u; r < input_rows; r++) {
        gradient[r] = where_on(sums[r], gradient_row(r) * dz_stride + column / 8u);
    }
}

// Replaces the upper layer's dz by the gradient of its input, which is the dz of the lower layer.
void descend() {
    GRADIENT gradients[input_columns * input_rows];
    [[unroll]] for (uint c = 0u; c < input_columns; c++) {
        GRADIENT gradient[input_rows];
        input_gradient(push.weights_at, gradient_column(c), gradient);
        [[unroll]] for (uint r = 0u; r < input_rows; r++) gradients[c * input_rows + r] = gradient[r];
    }
    barrier();
    [[unroll]] for (uint c = 0u; c < input_columns; c++) {
        [[unroll]] for (uint r = 0u; r < input_rows; r++) {
            uint at = gradient_row(r) * dz_stride + gradient_column(c) / 8u;
            STORE_F16(gradients[c * input_rows + r], tile_dz, at, dz_stride);
        }
    }
}

// Share of a subgroup of a weight gradient: numbers of tile rows and columns, stored from `first_tile` of `weight_gradient` on.
struct Share {
    uint first_tile;
    uint rows;
    uint columns;
    bool overhangs;
    uint row0;
    uint column0;
    uint width_in;
};

bool is_row(Share share, uint r) {
    return !share.overhangs || share.row0 + r * m < width;
}

bool is_tile(Share share, uint r, uint c) {
    return is_row(share, r) && (!share.overhangs || share.column0 + c * n < share.width_in);
}

Share upper_share() {
    return Share(0u, grad_rows, grad_columns, overhangs, gl_SubgroupID / shares * grad_rows * m,
                 gl_SubgroupID % shares * grad_columns * n, upper_columns);
}

Share lower_share() {
    return Share(upper_tiles, lower_rows, lower_grad_columns, lower_overhangs,
                 gl_SubgroupID / lower_shares * lower_rows * m, gl_SubgroupID % lower_shares * lower_grad_columns * n,
                 lower_columns);
}

void add_weight_gradient(Share share, uint inputs_at, uint stride) {
    STEPS for (uint step = 0u; step < tile / k; step++) {
        LEFT dz[max_rows];
        [[unroll]] for (uint r = 0u; r < share.rows; r++) {
            if (is_row(share, r)) {
                coopMatLoad(dz[r], tile_dz, step * k * dz_stride + (share.row0 + r * m) / 8u, dz_stride, COLUMNS);
            }
        }
        [[unroll]] for (uint c = 0u; c < share.columns; c++) {
            RIGHT inputs;
            if (is_tile(share, 0u, c)) {
                coopMatLoad(inputs, tile_in, inputs_at + step * k * stride + (share.column0 + c * n) / 8u, stride, ROWS);
            }
            [[unroll]] for (uint r = 0u; r < share.rows; r++) {
                uint t = share.first_tile + r * share.columns + c;
                if (is_tile(share, r, c)) weight_gradient[t] = coopMatMulAdd(dz[r], inputs, weight_gradient[t]);
            }
        }
    }
}

void put_weight_gradient(Share share, uint at, uint stride) {
    [[unroll]] for (uint r = 0u; r < share.rows; r++) {
        [[unroll]] for (uint c = 0u; c < share.columns; c++) {
            if (is_tile(share, r, c)) {
                uint tile_at = at + (share.row0 + r * m) * stride + share.column0 + c * n;
                SUM sum = weight_gradient[share.first_tile + r * share.columns + c];
                // An overflow must be visible in the sums, so that the loss scale is reduced.
                if (r == 0u && c == 0u && overflowed != 0u) sum[0] = uintBitsToFloat(0x7f800000u);
                if (push.accumulate != 0u) {
                    SUM before;
                    coopMatLoad(before, partials, tile_at, stride, ROWS);
                    sum = sum + before;
                }
                coopMatStore(sum, partials, tile_at, stride, ROWS);
            }
        }
    }
}

void clear_sums() {
    [[unroll]] for (uint i = 0u; i < upper_tiles + lower_rows * lower_grad_columns; i++) weight_gradient[i] = SUM(0.0);
    [[unroll]] for (uint i = 0u; i < lane_neurons; i++) {
        bias_sum[i] = 0.0;
        lower_bias_sum[i] = 0.0;
    }
    largest = 0.0;
    overflowed = 0u;
}

// Number of tiles of the live samples.
uint tiles_of(uint padded) {
    return (padded + tile - 1u) / tile;
}

// Writes the workgroup's sums after the last tile.
void put_sums() {
    barrier();
    if (largest >= LARGEST) overflowed = 1u;
    barrier();
    uint mine = gl_WorkGroupID.x * push.n_partials;
    put_weight_gradient(upper_share(), mine + push.weights_at, upper_columns);
    if (lower_columns != 0u) put_weight_gradient(lower_share(), mine + push.lower_weights_at, lower_columns);
    if (push.bias != NOWHERE) put_neuron_sums(bias_sum, mine + push.bias);
    if (push.lower_bias != NOWHERE) put_neuron_sums(lower_bias_sum, mine + push.lower_bias);
}
