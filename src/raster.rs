//! 2D arrays of numbers, and what is done to them: order statistics and grey morphology.

/// A row-major 2D array of floats.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height * width` values, rows first.
    pub values: Vec<f32>,
}

impl Image {
    /// An image of zeros.
    pub fn zeros(width: usize, height: usize) -> Image {
        Image { width, height, values: vec![0.0; width * height] }
    }
}

/// The value below which `share` of the values lie.
pub fn percentile(values: &[f32], share: f64) -> f32 {
    let mut sorted = values.to_vec();
    if sorted.is_empty() {
        return 0.0;
    }
    let index = ((sorted.len() - 1) as f64 * share) as usize;
    *sorted.select_nth_unstable_by(index, f32::total_cmp).1
}

fn filter(image: &Image, radius: usize, pick: impl Fn(f32, f32) -> f32 + Sync) -> Image {
    let (w, h) = (image.width, image.height);
    let window = |centre: usize, end: usize| centre.saturating_sub(radius)..(centre + radius + 1).min(end);
    let mut rows = Image::zeros(w, h);
    for y in 0..h {
        for x in 0..w {
            rows.values[y * w + x] = window(x, w).map(|k| image.values[y * w + k]).reduce(&pick).unwrap_or(0.0);
        }
    }
    let mut out = Image::zeros(w, h);
    for y in 0..h {
        for x in 0..w {
            out.values[y * w + x] = window(y, h).map(|k| rows.values[k * w + x]).reduce(&pick).unwrap_or(0.0);
        }
    }
    out
}

/// Grey dilation by a square of `2 radius + 1` pixels.
pub fn dilate(image: &Image, radius: usize) -> Image {
    filter(image, radius, f32::max)
}

/// A mask with a margin of so many pixels, as [`dilate`] has it.
pub fn widened(mask: &[bool], [width, height]: [usize; 2], pixels: usize) -> Vec<bool> {
    let values = mask.iter().map(|m| f32::from(u8::from(*m))).collect();
    dilate(&Image { width, height, values }, pixels).values.iter().map(|v| *v > 0.0).collect()
}

/// Grey opening: what is narrower than `2 radius + 1` pixels is cut down to its surroundings.
pub fn opening(image: &Image, radius: usize) -> Image {
    dilate(&filter(image, radius, f32::min), radius)
}

/// Median of each row's `2 radius + 1` pixels, then of each column's: in one or two directions what is narrower than half
/// that goes.
pub fn median_filter(image: &Image, radius: usize) -> Image {
    let (w, h) = (image.width, image.height);
    let window = |centre: usize, end: usize| centre.saturating_sub(radius)..(centre + radius + 1).min(end);
    let mut values = Vec::with_capacity(2 * radius + 1);
    let mut middle = |all: &mut dyn Iterator<Item = f32>| {
        values.clear();
        values.extend(all);
        median(&mut values)
    };
    let mut rows = Image::zeros(w, h);
    for (source, row) in image.values.chunks(w).zip(rows.values.chunks_mut(w)) {
        for (x, out) in row.iter_mut().enumerate() {
            *out = middle(&mut source[window(x, w)].iter().copied());
        }
    }
    let mut out = Image::zeros(w, h);
    for (p, out) in out.values.iter_mut().enumerate() {
        *out = middle(&mut window(p / w, h).map(|y| rows.values[y * w + p % w]));
    }
    out
}

/// The middle value; 0 of none. Reorders.
pub fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opening_cuts_thin_and_keeps_wide() {
        let mut image = Image::zeros(20, 20);
        for y in 0..20 {
            image.values[y * 20 + 3] = 1.0;
            for x in 8..20 {
                image.values[y * 20 + x] = 1.0;
            }
        }
        let opened = opening(&image, 2);
        assert_eq!((opened.values[5 * 20 + 3], opened.values[5 * 20 + 14]), (0.0, 1.0));
    }
}
