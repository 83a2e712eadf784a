// Positions that the host lists or pushes.
const uint NOWHERE = 0xffffffffu;       // comes from nowhere: zero; goes nowhere: not written
const uint PHASE_BIAS = 0x80000000u;    // in `pack_source`: an element of `[layer][phase][neuron]`, not of `params`
