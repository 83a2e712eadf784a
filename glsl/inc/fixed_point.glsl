// Sums in 64-bit fixed point, each a pair of a low and a high word. Sums of integers are exact, so the order of additions does
// not matter. With INT64, additions to memory use one integer of 64 bits instead of a pair, on devices with such atomics; the
// results are bit-identical. This file must be included before all code other than directives, because it contains extensions.
#ifdef INT64
#extension GL_EXT_shader_explicit_arithmetic_types_int64 : require
#extension GL_EXT_shader_atomic_int64 : require
#define FIXED_SUMS(SLOT, BLOCK, NAME) layout(binding = SLOT) buffer BLOCK { uint64_t NAME[]; }
#define ADD_FIXED_TO_MEMORY(SUMS, AT, VALUE) atomicAdd(SUMS[AT], packUint2x32(VALUE))
#else
#define FIXED_SUMS(SLOT, BLOCK, NAME) layout(binding = SLOT) buffer BLOCK { uint NAME[]; }
#define ADD_FIXED_TO_MEMORY(SUMS, AT, VALUE) ADD_FIXED(SUMS, AT, VALUE)
#endif

// Converts a number to 64-bit fixed point. `scale_high` is 2^(fractional bits - 32). The magnitude is split exactly into two
// words and then negated in two's complement if necessary.
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

// Converts a sum in fixed point to a number.
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

// Adds a fixed-point number to element AT of SUMS, which are words in memory or in shared memory.
#define ADD_FIXED(SUMS, AT, VALUE)                                                                                     \
    {                                                                                                                  \
        uvec2 addend = VALUE;                                                                                          \
        uint before = atomicAdd(SUMS[2u * (AT)], addend.x);                                                            \
        uint high = addend.y + (before + addend.x < before ? 1u : 0u);                                                 \
        if (high != 0u) atomicAdd(SUMS[2u * (AT) + 1u], high);                                                         \
    }
