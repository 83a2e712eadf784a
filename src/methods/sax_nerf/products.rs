//! Products of vectors that make up the gradients of the Lineformer's parameters.

use crate::kernels::constants as at;
use crate::kernels::layout::SaxProduct;
use crate::methods::sax_nerf::field::{SaxShape, WIDTH};

/// Length of a vec4.
const LANES: u32 = 4;
/// Length of a vector in vec4.
const WIDTH4: u32 = WIDTH as u32 / LANES;
/// Slices of the feed-forward part.
const SLICES: u32 = 4;

/// Returns the products of vectors, and the sums of single vectors, of a field's backward pass.
pub fn products(shape: SaxShape) -> Vec<SaxProduct> {
    let input = shape.n_features() as u32 / LANES;
    let (joint, joint_stride) = (at::LINEFORMER_INPUT + WIDTH as u32 * input, input + WIDTH4);
    let product = |left, right, first, stride, columns| SaxProduct { left, right, first, stride, columns };
    let square = |left, right, first| product(left, right, first, WIDTH4, WIDTH4);
    let sum = |left, first| product(left, 0, first, 0, 0);
    let (wide, row) = (SLICES * WIDTH4, WIDTH as u32);
    let mut all = vec![
        product(at::SAX_BY_JOINT, at::SAX_FEATURES, joint, joint_stride, input),
        product(at::SAX_BY_JOINT, at::SAX_BLOCK, joint + input, joint_stride, WIDTH4),
        product(at::SAX_BY_INPUT, at::SAX_FEATURES, at::LINEFORMER_INPUT, input, input),
        square(at::SAX_BY_OUT, at::SAX_SEEN, at::LINEFORMER_OUT),
        square(at::SAX_BY_QUERY, at::SAX_NORMAL1, at::LINEFORMER_QUERY),
        square(at::SAX_BY_KEY, at::SAX_NORMAL1, at::LINEFORMER_KEY),
        square(at::SAX_BY_VALUE, at::SAX_NORMAL1, at::LINEFORMER_VALUE),
        sum(at::SAX_BY_JOINT, at::LINEFORMER_JOINT_BIAS),
        sum(at::SAX_BY_INPUT, at::LINEFORMER_INPUT_BIAS),
        sum(at::SAX_BY_OUT, at::LINEFORMER_OUT + row * WIDTH4),
        sum(at::SAX_NORM1, at::LINEFORMER_NORM1),
        sum(at::SAX_NORM1 + 1, at::LINEFORMER_NORM1 + WIDTH4),
        sum(at::SAX_NORM2, at::LINEFORMER_NORM2),
        sum(at::SAX_NORM2 + 1, at::LINEFORMER_NORM2 + WIDTH4),
        sum(at::SAX_POSITION, at::LINEFORMER_POSITION),
        sum(at::SAX_DENSITY, at::LINEFORMER_DENSITY),
        sum(at::SAX_DENSITY + 1, at::LINEFORMER_DENSITY + WIDTH4),
    ];
    for to in 0..SLICES {
        let first = at::LINEFORMER_EXPAND + to * row * WIDTH4;
        all.push(square(at::SAX_BY_FIRST + to, at::SAX_NORMAL2, first));
        let first = at::LINEFORMER_CONTRACT + to * WIDTH4;
        all.push(product(at::SAX_BY_BLOCK, at::SAX_SECOND + to, first, wide, WIDTH4));
        for from in 0..SLICES {
            let first = at::LINEFORMER_MIX + to * row * wide + from * WIDTH4;
            all.push(product(at::SAX_BY_SECOND + to, at::SAX_FIRST + from, first, wide, WIDTH4));
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_has_one_gradient() {
        for shape in [SaxShape { levels: 16, base: 16, log2_table: 19 }, SaxShape { levels: 4, base: 3, log2_table: 6 }]
        {
            let all = products(shape);
            assert_eq!(all.len(), at::SAX_PRODUCTS as usize);
            let mut found = vec![0; shape.n_weights() / LANES as usize];
            for product in all {
                assert!(product.left < at::SAX_VECTORS);
                assert!(product.right < at::SAX_VECTORS || product.right == at::SAX_FEATURES);
                let rows = if product.columns == 0 { 1 } else { WIDTH as u32 };
                let columns = if product.columns == 0 { WIDTH4 } else { product.columns };
                for row in 0..rows {
                    (0..columns).for_each(|i| found[(product.first + row * product.stride + i) as usize] += 1);
                }
            }
            assert!(found.iter().all(|n| *n == 1), "{found:?}");
        }
    }
}
