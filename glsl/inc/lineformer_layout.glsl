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
