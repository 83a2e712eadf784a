// Where the Lineformer's numbers begin, in vec4; matrices are rows of inputs. Those of the input come last, as their
// number depends on the grid's levels.

const uint LINEFORMER_NORM1 = 0u;            // scales of the first normalisation, 32, then shifts
const uint LINEFORMER_QUERY = 16u;           // 32 x 32
const uint LINEFORMER_KEY = 272u;            // 32 x 32
const uint LINEFORMER_VALUE = 528u;          // 32 x 32
const uint LINEFORMER_POSITION = 784u;       // 8 heads x 2 x 2
const uint LINEFORMER_OUT = 792u;            // 32 x 32, then 32 biases
const uint LINEFORMER_NORM2 = 1056u;         // as the first
const uint LINEFORMER_EXPAND = 1072u;        // 128 x 32
const uint LINEFORMER_MIX = 2096u;           // 128 x 128
const uint LINEFORMER_CONTRACT = 6192u;      // 32 x 128
const uint LINEFORMER_INPUT_BIAS = 7216u;    // 32
const uint LINEFORMER_JOINT_BIAS = 7224u;    // 32
const uint LINEFORMER_DENSITY = 7232u;       // 32, then a bias and nothing
const uint LINEFORMER_INPUT = 7248u;         // 32 x the grid's features; behind them 32 x (features + 32) of the skip

// Vectors of 32 numbers that a sample leaves in the backward pass, for gradients of the Lineformer's numbers; `BY` are
// gradients before a layer's activation. Slices of 128 numbers, and scales and shifts, are vectors next to each other.
const uint SAX_FEATURES = 0u;
const uint SAX_NORMAL1 = 1u;
const uint SAX_SEEN = 2u;
const uint SAX_NORMAL2 = 3u;
const uint SAX_BLOCK = 4u;
const uint SAX_FIRST = 5u;       // four
const uint SAX_SECOND = 9u;      // four
const uint SAX_BY_INPUT = 13u;
const uint SAX_BY_QUERY = 14u;
const uint SAX_BY_KEY = 15u;
const uint SAX_BY_VALUE = 16u;
const uint SAX_BY_OUT = 17u;
const uint SAX_BY_FIRST = 18u;   // four
const uint SAX_BY_SECOND = 22u;  // four
const uint SAX_BY_BLOCK = 26u;
const uint SAX_BY_JOINT = 27u;
const uint SAX_NORM1 = 28u;      // two
const uint SAX_NORM2 = 30u;      // two
const uint SAX_POSITION = 32u;   // of the pair
const uint SAX_DENSITY = 33u;    // two, of the pair
const uint SAX_VECTORS = 35u;    // all of them
const uint SAX_PRODUCTS = 41u;   // gradients: 31 products of two of them, 10 that are sums of one

// Vectors that a pair keeps to itself in either pass.
const uint SAX_X1 = 35u;         // after the first layer
const uint SAX_X2 = 36u;         // after the attention
const uint SAX_X3 = 37u;         // after the layer on both
const uint SAX_BEFORE_FIRST = 38u;   // four, before their GELU
const uint SAX_BEFORE_SECOND = 42u;  // four
const uint SAX_QUERY = 46u;
const uint SAX_KEY = 47u;
const uint SAX_VALUE = 48u;
const uint SAX_BY_NORMAL = 49u;
const uint SAX_BY_SEEN = 50u;
const uint SAX_BY_FEATURES = 51u;
const uint SAX_ALL_VECTORS = 52u;    // those that are left come first

// What a step of the Lineformer does with vectors.
const uint SAX_SET = 0u;         // to = numbers at `first`
const uint SAX_ADD = 1u;         // to += from
const uint SAX_TIMES = 2u;       // to += W from
const uint SAX_BACK = 3u;        // to += W^T from
const uint SAX_LEAKY = 4u;       // to = leaky(to)
const uint SAX_GELU = 5u;        // to = gelu(from)
const uint SAX_NORM = 6u;        // to = from, normalised, by the scales and shifts at `first`
const uint SAX_ATTEND = 7u;      // what both samples see of each other
const uint SAX_BACK_LEAKY = 8u;  // to through the activation whose result is from
const uint SAX_BACK_GELU = 9u;   // to through the GELU of from
const uint SAX_BACK_NORM = 10u;  // to += BY_NORMAL through the normalisation of from; its scales and shifts are left
const uint SAX_BACK_ATTEND = 11u;
const uint SAX_BACK_DENSITY = 12u;
const uint SAX_CLEAR = 13u;      // to = 0
