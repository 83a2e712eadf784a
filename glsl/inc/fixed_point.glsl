// Sums in 64-bit fixed point, a pair of words each, low and high: integers add up exactly, so the order of additions
// does not matter. With INT64, what adds to memory takes a pair for one integer, for devices that add these atomically: the
// same bits come out. To be included before what is no directive: an extension precedes all else.
#ifdef INT64
#extension GL_EXT_shader_explicit_arithmetic_types_int64 : require
#extension GL_EXT_shader_atomic_int64 : require
#define FIXED_SUMS(SLOT, BLOCK, NAME) layout(binding = SLOT) buffer BLOCK { uint64_t NAME[]; }
#define ADD_FIXED_TO_MEMORY(SUMS, AT, VALUE) atomicAdd(SUMS[AT], packUint2x32(VALUE))
#else
#define FIXED_SUMS(SLOT, BLOCK, NAME) layout(binding = SLOT) buffer BLOCK { uint NAME[]; }
#define ADD_FIXED_TO_MEMORY(SUMS, AT, VALUE) ADD_FIXED(SUMS, AT, VALUE)
#endif

// A number in 64-bit fixed point, by 2 to the (bits behind the point - 32); the magnitude is split exactly into words,
// then negated in two's complement.
uvec2 to_fixed(float value, float scale_high) {
    float scaled = abs(value) * scale_high;
    float whole = floor(scaled);
    uint high = uint(whole);
    uint low = uint((scaled - whole) * 4294967296.0);
    if (value < 0.0) {
        low = ~low + 1u;
        high = ~high + (low == 0u ? 1u : 0u);
    }
    return uvec2(low, high);
}

// The number that a sum stands for.
float from_fixed(uvec2 sum, uint bits) {
    uint low = sum.x;
    uint high = sum.y;
    bool negative = (high & 0x80000000u) != 0u;
    if (negative) {
        low = ~low + 1u;
        high = ~high + (low == 0u ? 1u : 0u);
    }
    float magnitude = (float(high) * 4294967296.0 + float(low)) * exp2(-float(bits));
    return negative ? -magnitude : magnitude;
}

// Adds a number in fixed point to sum AT of SUMS, words in memory or shared by a workgroup.
#define ADD_FIXED(SUMS, AT, VALUE)                                                                                     \
    {                                                                                                                  \
        uvec2 addend = VALUE;                                                                                          \
        uint before = atomicAdd(SUMS[2u * (AT)], addend.x);                                                            \
        uint high = addend.y + (before + addend.x < before ? 1u : 0u);                                                 \
        if (high != 0u) atomicAdd(SUMS[2u * (AT) + 1u], high);                                                         \
    }
