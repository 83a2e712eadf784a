// What the backward passes on matrices share: a tile of samples, gradients to its input and of its weights, sums. What includes
// this declares the constants `upper_columns` and `lower_columns` (inputs of the upper layer, and of the layer below it that the pass goes
// on to, or 0), `shares` and `lower_shares`, the size of `tile_in`, the push constants, and `weights16` and `partials`.

const uint width8 = width / 8u;
const uint upper_columns8 = upper_columns / 8u;
const uint lower_columns8 = lower_columns / 8u;
// One more uvec4 a row keeps rows off the same banks.
const uint dz_stride = width8 + 1u;
const uint input_stride = upper_columns8 + 1u;
const uint lower_stride = lower_columns8 + 1u;
const uint row_tiles = tile / m;
const uint column_tiles = width / n;
// Weight gradient: subgroups are laid out in bands over neurons times shares of the inputs.
const uint bands = subgroups / shares;
const uint grad_rows = (width / m + bands - 1u) / bands;
const uint grad_columns = upper_columns / n / shares;
const uint lower_bands = subgroups / lower_shares;
const uint lower_rows = (width / m + lower_bands - 1u) / lower_bands;
const uint lower_grad_columns = lower_columns / n / lower_shares;
// Rows of the last band beyond the neurons: none unless m and n differ. Constants, so that drivers drop the tests.
const uint overhang = bands * grad_rows * m - width;
const uint lower_overhang = lower_bands * lower_rows * m - width;
const uint most_rows = grad_rows > lower_rows ? grad_rows : lower_rows;
const uint upper_tiles = grad_rows * grad_columns;
// Input gradient, which only hidden inputs have: subgroups are dealt columns of tiles, and where there are more of them, shares
// of the rows.
const uint row_shares = subgroups > column_tiles ? subgroups / column_tiles : 1u;
const uint input_rows = row_tiles / row_shares;
const uint input_columns = column_tiles * row_shares / subgroups;
// Staging: an invocation keeps its eight neurons from tile to tile.
const uint stage_rows = gl_WorkGroupSize.x / width8 > 0u ? gl_WorkGroupSize.x / width8 : 1u;
const uint scratch = 2u * gl_WorkGroupSize.x;
shared uvec4 tile_dz[tile * dz_stride > scratch ? tile * dz_stride : scratch];
shared uvec4 tile_in[INPUTS_SIZE];

SUM weight_gradient[upper_tiles + lower_rows * lower_grad_columns];
// Sums over the samples of an invocation's eight neurons.
float bias_sum[8];
float lower_bias_sum[8];
// Largest gradient in f16: what is larger than any becomes infinite on some devices, the largest there is on others.
float largest;
shared uint overflowed;

// Adds eight numbers of dz to a bias gradient.
#define ADD_DZ(sums, packed)                                  \
    [[unroll]] for (uint i = 0u; i < 4u; i++) {                \
        vec2 dz_pair = unpackHalf2x16(packed[i]);              \
        sums[2u * i] += dz_pair.x;                             \
        sums[2u * i + 1u] += dz_pair.y;                        \
    }

// The lower layer's dz, once it is in shared memory.
void add_lower_bias() {
    uint q = gl_LocalInvocationIndex % width8;
    uint row0 = gl_LocalInvocationIndex / width8;
    for (uint row = row0; row < tile && row0 < stage_rows; row += stage_rows) {
        uvec4 packed = tile_dz[row * dz_stride + q];
        ADD_DZ(lower_bias_sum, packed)
    }
}

// A tile of the gradient to a layer's input, from the dz and the input in shared memory.
SUM16 input_gradient(uint weights_at, uint row, uint column) {
    SUM sum = SUM(0.0);
    STEPS for (uint step = 0u; step < width / k; step++) {
        LEFT dz;
        RIGHT weights;
        coopMatLoad(dz, tile_dz, row * dz_stride + step * k / 8u, dz_stride, ROWS);
        coopMatLoad(weights, weights16, (weights_at + step * k * width + column) / 8u, width8, ROWS);
        sum = coopMatMulAdd(dz, weights, sum);
    }
    // Element order may differ between component types, so the mask is applied between equal types.
    SUM16 gradient = SUM16(sum), on;
    coopMatLoad(on, tile_in, row * dz_stride + column / 8u, dz_stride, ROWS);
    [[unroll]] for (uint i = 0u; i < gradient.length(); i++) {
        gradient[i] = on[i] > float16_t(0.0) ? gradient[i] : float16_t(0.0);
        largest = max(largest, abs(float(gradient[i])));
    }
    return gradient;
}

// The gradient to the upper layer's input takes the place of its dz: it is the lower layer's.
void descend() {
    SUM16 gradient[input_rows * input_columns];
    [[unroll]] for (uint c = 0u; c < input_columns; c++) {
        uint column = (gl_SubgroupID % column_tiles + c * subgroups) * n;
        [[unroll]] for (uint r = 0u; r < input_rows; r++) {
            uint row = (gl_SubgroupID / column_tiles + r * row_shares) * m;
            gradient[c * input_rows + r] = input_gradient(push.weights_at, row, column);
        }
    }
    barrier();
    [[unroll]] for (uint c = 0u; c < input_columns; c++) {
        uint column = (gl_SubgroupID % column_tiles + c * subgroups) * n;
        [[unroll]] for (uint r = 0u; r < input_rows; r++) {
            uint row = (gl_SubgroupID / column_tiles + r * row_shares) * m;
            coopMatStore(gradient[c * input_rows + r], tile_dz, row * dz_stride + column / 8u, dz_stride, ROWS);
        }
    }
}

// A weight gradient's share of a subgroup: so many tiles of rows and columns, from `first_tile` of `weight_gradient` on.
struct Share {
    uint first_tile;
    uint rows;
    uint columns;
    uint overhang;
    uint row0;
    uint column0;
};

bool is_row(Share share, uint r) {
    return share.overhang == 0u || share.row0 + r * m < width;
}

Share upper_share() {
    return Share(0u, grad_rows, grad_columns, overhang, gl_SubgroupID / shares * grad_rows * m,
                 gl_SubgroupID % shares * grad_columns * n);
}

Share lower_share() {
    return Share(upper_tiles, lower_rows, lower_grad_columns, lower_overhang,
                 gl_SubgroupID / lower_shares * lower_rows * m, gl_SubgroupID % lower_shares * lower_grad_columns * n);
}

void add_weight_gradient(Share share, uint inputs_at, uint stride) {
    STEPS for (uint step = 0u; step < tile / k; step++) {
        LEFT dz[most_rows];
        [[unroll]] for (uint r = 0u; r < share.rows; r++) {
            if (is_row(share, r)) {
                coopMatLoad(dz[r], tile_dz, step * k * dz_stride + (share.row0 + r * m) / 8u, dz_stride, COLUMNS);
            }
        }
        [[unroll]] for (uint c = 0u; c < share.columns; c++) {
            RIGHT inputs;
            coopMatLoad(inputs, tile_in, inputs_at + step * k * stride + (share.column0 + c * n) / 8u, stride, ROWS);
            [[unroll]] for (uint r = 0u; r < share.rows; r++) {
                uint t = share.first_tile + r * share.columns + c;
                if (is_row(share, r)) weight_gradient[t] = coopMatMulAdd(dz[r], inputs, weight_gradient[t]);
            }
        }
    }
}

void put_weight_gradient(Share share, uint at, uint stride) {
    [[unroll]] for (uint r = 0u; r < share.rows; r++) {
        if (is_row(share, r)) {
            [[unroll]] for (uint c = 0u; c < share.columns; c++) {
                uint tile_at = at + (share.row0 + r * m) * stride + share.column0 + c * n;
                SUM sum = weight_gradient[share.first_tile + r * share.columns + c];
                // An overflow must show in the sums, for the loss scale to give way.
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

void put(uint at, float value) {
    partials[at] = value + (push.accumulate != 0u ? partials[at] : 0.0);
}

// Adds the eight sums of each invocation over the rows of staging, in row order.
void put_neuron_sums(float sums[8], uint at) {
    barrier();
    [[unroll]] for (uint i = 0u; i < 2u; i++) {
        tile_dz[2u * gl_LocalInvocationIndex + i] =
            floatBitsToUint(vec4(sums[4u * i], sums[4u * i + 1u], sums[4u * i + 2u], sums[4u * i + 3u]));
    }
    barrier();
    for (uint neuron = gl_LocalInvocationIndex; neuron < width; neuron += gl_WorkGroupSize.x) {
        float total = 0.0;
        for (uint row = 0u; row < stage_rows; row++) {
            total += uintBitsToFloat(tile_dz[2u * (row * width8 + neuron / 8u) + (neuron & 7u) / 4u][neuron & 3u]);
        }
        put(at + neuron, total);
    }
}

void clear_sums() {
    [[unroll]] for (uint i = 0u; i < upper_tiles + lower_rows * lower_grad_columns; i++) weight_gradient[i] = SUM(0.0);
    [[unroll]] for (uint i = 0u; i < 8u; i++) {
        bias_sum[i] = 0.0;
        lower_bias_sum[i] = 0.0;
    }
    largest = 0.0;
    overflowed = 0u;
}

// Tiles of the live samples.
uint tiles_of(uint padded) {
    return (padded + tile - 1u) / tile;
}

// After the last tile: what a workgroup has summed.
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
