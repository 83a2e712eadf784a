// Positions at which the Lineformer's numbers begin, in vec4; matrices are rows of inputs. The numbers of the input layer come
// last, because their count depends on the number of the grid's levels.

const uint LINEFORMER_NORM1 = 0u;            // Scales of the first normalisation, 32, followed by its shifts.
const uint LINEFORMER_QUERY = 16u;           // Query matrix, 32 x 32.
const uint LINEFORMER_KEY = 272u;            // Key matrix, 32 x 32.
const uint LINEFORMER_VALUE = 528u;          // Value matrix, 32 x 32.
const uint LINEFORMER_POSITION = 784u;       // Position biases of the attention, 8 heads x 2 x 2.
const uint LINEFORMER_OUT = 792u;            // Output matrix of the attention, 32 x 32, followed by 32 biases.
const uint LINEFORMER_NORM2 = 1056u;         // Scales of the second normalisation, 32, followed by its shifts.
const uint LINEFORMER_EXPAND = 1072u;        // First matrix of the feed-forward block, 128 x 32.
const uint LINEFORMER_MIX = 2096u;           // Second matrix of the feed-forward block, 128 x 128.
const uint LINEFORMER_CONTRACT = 6192u;      // Third matrix of the feed-forward block, 32 x 128.
const uint LINEFORMER_INPUT_BIAS = 7216u;    // Biases of the input layer, 32.
const uint LINEFORMER_JOINT_BIAS = 7224u;    // Biases of the joint layer, 32.
const uint LINEFORMER_DENSITY = 7232u;       // Weights of the density, 32, followed by a bias and unused numbers.
const uint LINEFORMER_INPUT = 7248u;         // Input matrix, 32 x features, then the joint layer's, 32 x (features + 32).

// Vectors of 32 numbers that each sample of a chunk has; larger vectors are several consecutive ones. The vectors of the
// forward pass come first.
const uint SAX_X1 = 0u;              // Output of the first layer.
const uint SAX_NORMAL1 = 1u;
const uint SAX_QUERY = 2u;           // Queries, followed by keys and values.
const uint SAX_KEY = 3u;
const uint SAX_VALUE = 4u;
const uint SAX_SEEN = 5u;
const uint SAX_X2 = 6u;              // Sum after the attention.
const uint SAX_NORMAL2 = 7u;
const uint SAX_BEFORE_FIRST = 8u;    // Four vectors before the first GELU.
const uint SAX_FIRST = 12u;          // Four vectors after the first GELU.
const uint SAX_BEFORE_SECOND = 16u;  // Four vectors before the second GELU.
const uint SAX_SECOND = 20u;         // Four vectors after the second GELU.
const uint SAX_BLOCK = 24u;
const uint SAX_X3 = 25u;             // Output of the joint layer.
const uint SAX_FORWARD_VECTORS = 26u;

// Vectors of the backward pass; those with `BY` are gradients before a layer's activation.
const uint SAX_BY_INPUT = 26u;
const uint SAX_BY_QUERY = 27u;       // Gradient of the queries, followed by those of keys and values.
const uint SAX_BY_KEY = 28u;
const uint SAX_BY_VALUE = 29u;
const uint SAX_BY_OUT = 30u;
const uint SAX_BY_FIRST = 31u;       // Four vectors.
const uint SAX_BY_SECOND = 35u;      // Four vectors.
const uint SAX_BY_BLOCK = 39u;
const uint SAX_BY_JOINT = 40u;
const uint SAX_NORM1 = 41u;          // Two vectors: gradients of scales and of shifts.
const uint SAX_NORM2 = 43u;          // Two vectors: gradients of scales and of shifts.
const uint SAX_POSITION = 45u;
const uint SAX_DENSITY = 46u;        // Two vectors: gradients of the weights and of the bias.
const uint SAX_BY_NORMAL = 48u;
const uint SAX_BY_SEEN = 49u;
const uint SAX_VECTORS = 50u;        // Number of all vectors.

const uint SAX_FEATURES = 255u;      // Value for the features of the grid instead of a vector.
const uint SAX_NONE = 254u;          // Value for no vector.
const uint SAX_PRODUCTS = 41u;       // Number of gradients: 31 products of two vectors and 10 sums of one vector.

// Activation after a linear layer.
const uint SAX_PLAIN = 0u;
const uint SAX_LEAKY = 1u;
const uint SAX_GELU = 2u;            // GELU; the vectors before and after it are both stored.
