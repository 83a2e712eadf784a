// One pass of the sort of Gaussians by set and depth: stable, by four bits. A workgroup has a block of 1024 keys, and each lane
// has 16 consecutive keys. The including file must declare `push` with n_keys, n_blocks and shift, `blend_keys` and `blend_set_of`.

// Number of keys of a lane, and of a block.
const uint KEYS_OF_LANE = 16u;
const uint KEYS_OF_BLOCK = KEYS_OF_LANE * gl_WorkGroupSize.x;
// Number of values of four bits.
const uint DIGITS = 16u;
// Number of bits of the depth; the bits of the set follow.
const uint DEPTH_BITS = 32u;

// [digit][lane]
shared uint of_lanes[DIGITS * gl_WorkGroupSize.x];

uint digit_of(BlendKey key) {
    uint bits = push.shift < DEPTH_BITS ? key.depth >> push.shift : blend_set_of[key.index] >> (push.shift - DEPTH_BITS);
    return bits & (DIGITS - 1u);
}

// First key of the lane and one more than its last.
uvec2 keys_of_lane() {
    uint first = workgroup() * KEYS_OF_BLOCK + gl_LocalInvocationID.x * KEYS_OF_LANE;
    return min(uvec2(first, first + KEYS_OF_LANE), uvec2(push.n_keys));
}

// Counts the digits of each lane; afterwards the counts are valid in all lanes.
void count_digits() {
    uint lane = gl_LocalInvocationID.x;
    for (uint digit = 0u; digit < DIGITS; digit++) of_lanes[digit * gl_WorkGroupSize.x + lane] = 0u;
    uvec2 own = keys_of_lane();
    for (uint i = own.x; i < own.y; i++) of_lanes[digit_of(blend_keys[i]) * gl_WorkGroupSize.x + lane] += 1u;
    barrier();
}
