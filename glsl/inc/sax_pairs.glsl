// Which samples of a ray see each other, of rays of `push.row` samples, cut into pairs from their first on; the last of an odd
// number is a pair with itself. `push.first` is the chunk's first sample along its ray.

struct Pair {
    uint other;                 // the sample that is seen beside itself
    bool is_second;
};

Pair pair_of(uint s) {
    uint k = (push.first + s) % push.row;
    if (k % 2u == 1u) return Pair(s - 1u, true);
    return Pair(k + 1u < push.row ? s + 1u : s, false);
}

// Share of a sample's own values in what it sees by a head. Of two, the softmax is a sigmoid of their difference; queries are
// halved, by the root of a head's size. `positions`: first of first, second of first, first of second, second of second.
float own_share(vec4 query, vec4 own_key, vec4 other_key, vec4 positions, bool is_second) {
    float apart = is_second ? positions.w - positions.z : positions.x - positions.y;
    return 1.0 / (1.0 + exp(-0.5 * dot(query, own_key - other_key) - apart));
}
