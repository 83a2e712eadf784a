// Pairs of samples between which attention is computed. A ray of `push.row` samples is divided into pairs from its first sample
// on; with an odd number, the last sample is paired with itself. `push.first` is the position of the chunk's first sample along
// its ray.

struct Pair {
    uint other;                 // other sample of the pair
    bool is_second;
};

Pair pair_of(uint s) {
    uint k = (push.first + s) % push.row;
    if (k % 2u == 1u) return Pair(s - 1u, true);
    return Pair(k + 1u < push.row ? s + 1u : s, false);
}

// Attention weight of a sample's own values in a head. The softmax of two scores is a sigmoid of their difference; the factor
// 0.5 is the inverse root of a head's size. `positions`: biases of first to first, first to second, second to first, second to
// second.
float own_share(vec4 query, vec4 own_key, vec4 other_key, vec4 positions, bool is_second) {
    float apart = is_second ? positions.w - positions.z : positions.x - positions.y;
    return 1.0 / (1.0 + exp(-0.5 * dot(query, own_key - other_key) - apart));
}
