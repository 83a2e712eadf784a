//! Counter-based random numbers, bit-equal to `glsl/inc/random.glsl`: pcg4d (Jarzynski and Olano,
//! "Hash Functions for GPU Rendering", JCGT 2020).

// Streams, `STREAM_*`: made by build.rs.
include!(concat!(env!("OUT_DIR"), "/constants_random.rs"));

/// The hash: four words in, four words out.
pub fn pcg4d(v: [u32; 4]) -> [u32; 4] {
    let mut v = v.map(|x| x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    let mix = |v: &mut [u32; 4]| {
        v[0] = v[0].wrapping_add(v[1].wrapping_mul(v[3]));
        v[1] = v[1].wrapping_add(v[2].wrapping_mul(v[0]));
        v[2] = v[2].wrapping_add(v[0].wrapping_mul(v[1]));
        v[3] = v[3].wrapping_add(v[1].wrapping_mul(v[2]));
    };
    mix(&mut v);
    v = v.map(|x| x ^ (x >> 16));
    mix(&mut v);
    v
}

/// Uniform in [0, 1) with 24 bits.
pub fn uniform01(seed: u32, stream: u32, a: u32, b: u32) -> f64 {
    f64::from(pcg4d([seed, stream, a, b])[0] >> 8) / 16_777_216.0
}

/// Standard normal (Box-Muller).
pub fn normal(seed: u32, stream: u32, a: u32, b: u32) -> f64 {
    let [x, y, ..] = pcg4d([seed, stream, a, b]);
    let u = (f64::from(x) + 1.0) / 4_294_967_296.0;
    let v = f64::from(y) / 4_294_967_296.0;
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Element `index` of a pseudo-random permutation of `[0, n)`.
pub fn permute(index: u32, n: u32, seed: u32, epoch: u32, stream: u32) -> u32 {
    let mut half_bits = 1;
    while half_bits < 16 && (1u64 << (2 * half_bits)) < u64::from(n) {
        half_bits += 1;
    }
    let mask = (1u32 << half_bits) - 1;
    let mut x = index;
    loop {
        let (mut left, mut right) = (x >> half_bits, x & mask);
        for round in 0..4 {
            let mixed = pcg4d([right, seed ^ (stream << 28), epoch, round])[0] & mask;
            (left, right) = (right, left ^ mixed);
        }
        x = (left << half_bits) | right;
        if x < n {
            return x;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn permute_is_a_permutation() {
        for n in [1u32, 2, 3, 17, 64, 1000, 4097] {
            let mut seen = vec![false; n as usize];
            for i in 0..n {
                let x = permute(i, n, 7, 3, STREAM_RAY) as usize;
                assert!(!std::mem::replace(&mut seen[x], true), "n = {n}");
            }
        }
        let (a, b) = (permute(5, 1000, 7, 0, STREAM_RAY), permute(5, 1000, 7, 1, STREAM_RAY));
        assert_ne!(a, b, "epochs differ");
    }

    #[test]
    fn moments_of_the_normal() {
        let n = 20_000;
        let draws: Vec<f64> = (0..n).map(|i| normal(1, STREAM_INIT, 0, i)).collect();
        let mean = draws.iter().sum::<f64>() / f64::from(n);
        let var = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / f64::from(n);
        assert!(mean.abs() < 0.03 && (var - 1.0).abs() < 0.05, "{mean} {var}");
    }
}
