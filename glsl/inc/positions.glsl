// Special values in the positions that the host lists or pushes.
const uint NOWHERE = 0xffffffffu;       // position without a source or target: a zero is read, or nothing is written
const uint PHASE_BIAS = 0x80000000u;    // flag in `pack_source` of an element of `[layer][phase][neuron]` instead of `params`
