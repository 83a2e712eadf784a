//! The Lineformer, step by step: forward, then back.

use crate::kernels::constants as at;
use crate::kernels::layout::SaxStep;
use crate::model::sax::{SaxShape, WIDTH};

/// Numbers of a vec4.
const LANES: u32 = 4;
/// A vector in vec4, and a matrix of 32 x 32.
const WIDTH4: u32 = WIDTH as u32 / LANES;
const SQUARE: u32 = WIDTH as u32 * WIDTH4;
/// Slices of the feed-forward part, and its rows.
const SLICES: u32 = 4;
const WIDE4: u32 = SLICES * WIDTH4;

/// A matrix among the numbers: where it begins, from row to row, and its columns, all in vec4.
#[derive(Clone, Copy)]
struct Matrix {
    first: u32,
    stride: u32,
    columns: u32,
}

/// A matrix of as many columns as a vector has numbers.
fn matrix(first: u32, stride: u32) -> Matrix {
    Matrix { first, stride, columns: WIDTH4 }
}

fn expand(slice: u32) -> Matrix {
    matrix(at::LINEFORMER_EXPAND + slice * SQUARE, WIDTH4)
}

fn mix(to: u32, from: u32) -> Matrix {
    matrix(at::LINEFORMER_MIX + to * WIDTH as u32 * WIDE4 + from * WIDTH4, WIDE4)
}

fn contract(slice: u32) -> Matrix {
    matrix(at::LINEFORMER_CONTRACT + slice * WIDTH4, WIDE4)
}

/// Matrices of the first layer, and of the layer on both: what it takes of the features, and of the block.
fn layers(shape: SaxShape) -> [Matrix; 3] {
    let input = shape.n_features() as u32 / LANES;
    let joint = at::LINEFORMER_INPUT + WIDTH as u32 * input;
    let stride = input + WIDTH4;
    [
        Matrix { first: at::LINEFORMER_INPUT, stride: input, columns: input },
        Matrix { first: joint, stride, columns: input },
        matrix(joint + input, stride),
    ]
}

fn step(kind: u32, to: u32, from: u32) -> SaxStep {
    SaxStep { kind, to, from, ..SaxStep::default() }
}

fn set(to: u32, first: u32) -> SaxStep {
    SaxStep { first, ..step(at::SAX_SET, to, to) }
}

fn by(kind: u32, to: u32, from: u32, m: Matrix) -> SaxStep {
    SaxStep { first: m.first, stride: m.stride, columns: m.columns, ..step(kind, to, from) }
}

fn times(to: u32, from: u32, m: Matrix) -> SaxStep {
    by(at::SAX_TIMES, to, from, m)
}

fn back(to: u32, from: u32, m: Matrix) -> SaxStep {
    by(at::SAX_BACK, to, from, m)
}

/// Steps from features to the last layer's result: vectors that are added to are zero before.
pub fn forward(shape: SaxShape) -> Vec<SaxStep> {
    let [input, of_features, of_block] = layers(shape);
    let mut all = vec![
        set(at::SAX_X1, at::LINEFORMER_INPUT_BIAS),
        times(at::SAX_X1, at::SAX_FEATURES, input),
        step(at::SAX_LEAKY, at::SAX_X1, at::SAX_X1),
        SaxStep { first: at::LINEFORMER_NORM1, ..step(at::SAX_NORM, at::SAX_NORMAL1, at::SAX_X1) },
        times(at::SAX_QUERY, at::SAX_NORMAL1, matrix(at::LINEFORMER_QUERY, WIDTH4)),
        times(at::SAX_KEY, at::SAX_NORMAL1, matrix(at::LINEFORMER_KEY, WIDTH4)),
        times(at::SAX_VALUE, at::SAX_NORMAL1, matrix(at::LINEFORMER_VALUE, WIDTH4)),
        step(at::SAX_ATTEND, at::SAX_SEEN, at::SAX_VALUE),
        set(at::SAX_X2, at::LINEFORMER_OUT + SQUARE),
        times(at::SAX_X2, at::SAX_SEEN, matrix(at::LINEFORMER_OUT, WIDTH4)),
        step(at::SAX_ADD, at::SAX_X2, at::SAX_X1),
        SaxStep { first: at::LINEFORMER_NORM2, ..step(at::SAX_NORM, at::SAX_NORMAL2, at::SAX_X2) },
        step(at::SAX_ADD, at::SAX_BLOCK, at::SAX_X2),
    ];
    for slice in 0..SLICES {
        all.push(times(at::SAX_BEFORE_FIRST + slice, at::SAX_NORMAL2, expand(slice)));
        all.push(step(at::SAX_GELU, at::SAX_FIRST + slice, at::SAX_BEFORE_FIRST + slice));
    }
    for slice in 0..SLICES {
        let before = at::SAX_BEFORE_SECOND + slice;
        all.extend((0..SLICES).map(|from| times(before, at::SAX_FIRST + from, mix(slice, from))));
        all.push(step(at::SAX_GELU, at::SAX_SECOND + slice, before));
        all.push(times(at::SAX_BLOCK, at::SAX_SECOND + slice, contract(slice)));
    }
    all.extend([
        step(at::SAX_LEAKY, at::SAX_BLOCK, at::SAX_BLOCK),
        set(at::SAX_X3, at::LINEFORMER_JOINT_BIAS),
        times(at::SAX_X3, at::SAX_FEATURES, of_features),
        times(at::SAX_X3, at::SAX_BLOCK, of_block),
        step(at::SAX_LEAKY, at::SAX_X3, at::SAX_X3),
    ]);
    all
}

/// Steps back to the gradient by features, behind those of [`forward`].
pub fn backward(shape: SaxShape) -> Vec<SaxStep> {
    let [input, of_features, of_block] = layers(shape);
    let mut all = vec![
        step(at::SAX_BACK_DENSITY, at::SAX_BY_JOINT, at::SAX_X3),
        step(at::SAX_BACK_LEAKY, at::SAX_BY_JOINT, at::SAX_X3),
        back(at::SAX_BY_FEATURES, at::SAX_BY_JOINT, of_features),
        back(at::SAX_BY_BLOCK, at::SAX_BY_JOINT, of_block),
        step(at::SAX_BACK_LEAKY, at::SAX_BY_BLOCK, at::SAX_BLOCK),
    ];
    for slice in 0..SLICES {
        all.push(back(at::SAX_BY_SECOND + slice, at::SAX_BY_BLOCK, contract(slice)));
        all.push(step(at::SAX_BACK_GELU, at::SAX_BY_SECOND + slice, at::SAX_BEFORE_SECOND + slice));
    }
    for slice in 0..SLICES {
        let to = at::SAX_BY_FIRST + slice;
        all.extend((0..SLICES).map(|from| back(to, at::SAX_BY_SECOND + from, mix(from, slice))));
        all.push(step(at::SAX_BACK_GELU, to, at::SAX_BEFORE_FIRST + slice));
        all.push(back(at::SAX_BY_NORMAL, to, expand(slice)));
    }
    let norm_back = |to: u32, from: u32, first: u32, left_as: u32| SaxStep {
        first,
        columns: left_as,
        ..step(at::SAX_BACK_NORM, to, from)
    };
    let from_attention = [at::SAX_BY_QUERY, at::SAX_BY_KEY, at::SAX_BY_VALUE];
    let matrices = [at::LINEFORMER_QUERY, at::LINEFORMER_KEY, at::LINEFORMER_VALUE];
    all.extend([
        step(at::SAX_ADD, at::SAX_BY_OUT, at::SAX_BY_BLOCK),
        norm_back(at::SAX_BY_OUT, at::SAX_X2, at::LINEFORMER_NORM2, at::SAX_NORM2),
        back(at::SAX_BY_SEEN, at::SAX_BY_OUT, matrix(at::LINEFORMER_OUT, WIDTH4)),
        step(at::SAX_BACK_ATTEND, at::SAX_BY_VALUE, at::SAX_BY_SEEN),
        step(at::SAX_CLEAR, at::SAX_BY_NORMAL, at::SAX_BY_NORMAL),
    ]);
    all.extend(
        from_attention.iter().zip(matrices).map(|(d, first)| back(at::SAX_BY_NORMAL, *d, matrix(first, WIDTH4))),
    );
    all.extend([
        step(at::SAX_ADD, at::SAX_BY_INPUT, at::SAX_BY_OUT),
        norm_back(at::SAX_BY_INPUT, at::SAX_X1, at::LINEFORMER_NORM1, at::SAX_NORM1),
        step(at::SAX_BACK_LEAKY, at::SAX_BY_INPUT, at::SAX_X1),
        back(at::SAX_BY_FEATURES, at::SAX_BY_INPUT, input),
    ]);
    all
}
