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

// Vectors of 32 numbers that each sample of a chunk has; more numbers are vectors next to each other. First those of the
// forward pass.
const uint SAX_X1 = 0u;              // after the first layer
const uint SAX_NORMAL1 = 1u;
const uint SAX_QUERY = 2u;           // then keys and values
const uint SAX_KEY = 3u;
const uint SAX_VALUE = 4u;
const uint SAX_SEEN = 5u;
const uint SAX_X2 = 6u;              // after the attention
const uint SAX_NORMAL2 = 7u;
const uint SAX_BEFORE_FIRST = 8u;    // four, before their GELU
const uint SAX_FIRST = 12u;          // four
const uint SAX_BEFORE_SECOND = 16u;  // four
const uint SAX_SECOND = 20u;         // four
const uint SAX_BLOCK = 24u;
const uint SAX_X3 = 25u;             // after the layer on both
const uint SAX_FORWARD_VECTORS = 26u;

// Those of the backward pass; `BY` are gradients before a layer's activation.
const uint SAX_BY_INPUT = 26u;
const uint SAX_BY_QUERY = 27u;       // then by keys and values
const uint SAX_BY_KEY = 28u;
const uint SAX_BY_VALUE = 29u;
const uint SAX_BY_OUT = 30u;
const uint SAX_BY_FIRST = 31u;       // four
const uint SAX_BY_SECOND = 35u;      // four
const uint SAX_BY_BLOCK = 39u;
const uint SAX_BY_JOINT = 40u;
const uint SAX_NORM1 = 41u;          // two: by scales and shifts
const uint SAX_NORM2 = 43u;          // two
const uint SAX_POSITION = 45u;
const uint SAX_DENSITY = 46u;        // two
const uint SAX_BY_NORMAL = 48u;
const uint SAX_BY_SEEN = 49u;
const uint SAX_VECTORS = 50u;        // all of them

const uint SAX_FEATURES = 255u;      // no vector, but the features of the grid
const uint SAX_NONE = 254u;          // no vector
const uint SAX_PRODUCTS = 41u;       // gradients: 31 products of two vectors, 10 that are sums of one

// What follows a product.
const uint SAX_PLAIN = 0u;
const uint SAX_LEAKY = 1u;
const uint SAX_GELU = 2u;            // the result is left twice: before, and after
