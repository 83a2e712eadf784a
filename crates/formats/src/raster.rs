//! 2D arrays of numbers, with order statistics and grey morphology.

/// A row-major 2D array of floats.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height * width` values in row-major order.
    pub values: Vec<f32>,
}

impl Image {
    /// An image of zeros.
    pub fn zeros(width: usize, height: usize) -> Image {
        Image { width, height, values: vec![0.0; width * height] }
    }

    /// Returns the transposed image: rows become columns.
    fn transposed(&self) -> Image {
        let columns = (0..self.width).flat_map(|x| self.values[x..].iter().step_by(self.width));
        Image { width: self.height, height: self.width, values: columns.copied().collect() }
    }
}

/// Returns the value below which the fraction `share` of the values lies; 0 if there are no values.
pub fn percentile(values: &[f32], share: f64) -> f32 {
    let mut sorted = values.to_vec();
    if sorted.is_empty() {
        return 0.0;
    }
    let index = ((sorted.len() - 1) as f64 * share) as usize;
    *sorted.select_nth_unstable_by(index, f32::total_cmp).1
}

/// Reduces each square of `2 radius + 1` pixels to one of its values by picking between two at a time; `neutral` is never
/// picked over another value.
fn filter(image: &Image, radius: usize, neutral: f32, pick: impl Fn(f32, f32) -> f32) -> Image {
    let rows = filter_rows(image, radius, neutral, &pick);
    filter_rows(&rows.transposed(), radius, neutral, &pick).transposed()
}

/// Filters along rows with three comparisons per pixel for any radius (van Herk 1992): each window is the end of one block of
/// its length and the beginning of the next.
fn filter_rows(image: &Image, radius: usize, neutral: f32, pick: &impl Fn(f32, f32) -> f32) -> Image {
    // A window from any pixel holds the whole row with this radius.
    let radius = radius.min(image.width);
    let window = 2 * radius + 1;
    let padded = (image.width + 2 * radius).next_multiple_of(window);
    let (mut line, mut ends) = (vec![neutral; padded], vec![neutral; padded]);
    let mut out = Image::zeros(image.width, image.height);
    for (row, out) in image.values.chunks(image.width).zip(out.values.chunks_mut(image.width)) {
        line.fill(neutral);
        line[radius..][..row.len()].copy_from_slice(row);
        ends.copy_from_slice(&line);
        for (begins, ends) in line.chunks_mut(window).zip(ends.chunks_mut(window)) {
            (1..window).for_each(|i| begins[i] = pick(begins[i - 1], begins[i]));
            (0..window - 1).rev().for_each(|i| ends[i] = pick(ends[i], ends[i + 1]));
        }
        for (x, out) in out.iter_mut().enumerate() {
            *out = pick(ends[x], line[x + window - 1]);
        }
    }
    out
}

/// Grey dilation by a square of `2 radius + 1` pixels.
pub fn dilate(image: &Image, radius: usize) -> Image {
    filter(image, radius, f32::NEG_INFINITY, f32::max)
}

/// Widens a mask by `pixels` pixels on all sides, with the square of [`dilate`].
pub fn widened(mask: &[bool], [width, height]: [usize; 2], pixels: usize) -> Vec<bool> {
    let values = mask.iter().map(|m| f32::from(u8::from(*m))).collect();
    dilate(&Image { width, height, values }, pixels).values.iter().map(|v| *v > 0.0).collect()
}

/// Grey opening: structures narrower than `2 radius + 1` pixels are reduced to the values around them.
pub fn opening(image: &Image, radius: usize) -> Image {
    dilate(&filter(image, radius, f32::INFINITY, f32::min), radius)
}

/// Median over `2 radius + 1` pixels of each row, then of each column: removes structures that are narrower than half of this
/// window in one or both directions. Values must be numbers.
pub fn median_filter(image: &Image, radius: usize) -> Image {
    median_of_columns(&median_of_columns(&image.transposed(), radius).transposed(), radius)
}

/// Replaces each value by the median of its window in the column.
fn median_of_columns(image: &Image, radius: usize) -> Image {
    let (width, height) = (image.width, image.height);
    let radius = radius.min(height);
    let mut out = Image::zeros(width, height);
    for first in (0..width).step_by(SortedWindows::COLUMNS) {
        let count = SortedWindows::COLUMNS.min(width - first);
        let row = |y: usize| {
            let mut row = [0.0; SortedWindows::COLUMNS];
            row[..count].copy_from_slice(&image.values[y * width + first..][..count]);
            row
        };
        let mut windows = SortedWindows { rows: Vec::with_capacity(2 * radius + 1) };
        (0..radius).for_each(|y| windows.insert(row(y)));
        for y in 0..height {
            let entering = (y + radius < height).then(|| row(y + radius));
            let leaving = y.checked_sub(radius + 1).map(row);
            match (leaving, entering) {
                (Some(leaving), Some(entering)) => windows.replace(&leaving, entering),
                (None, Some(entering)) => windows.insert(entering),
                (Some(leaving), None) => windows.remove(&leaving),
                (None, None) => {}
            }
            out.values[y * width + first..][..count].copy_from_slice(&windows.medians()[..count]);
        }
    }
    out
}

/// Windows of neighbouring columns, each of which is kept sorted while it moves along its column. No step depends on the values, so a
/// compiler can process several columns in one instruction.
struct SortedWindows {
    /// `[rank][column]`: the values of each window in ascending order.
    rows: Vec<[f32; SortedWindows::COLUMNS]>,
}

impl SortedWindows {
    const COLUMNS: usize = 16;

    /// Adds a value to each window: at each rank the smaller one of two values stays, and the larger one moves on.
    fn insert(&mut self, mut moving: [f32; Self::COLUMNS]) {
        for row in &mut self.rows {
            for (value, moving) in row.iter_mut().zip(&mut moving) {
                (*value, *moving) = ordered(*value, *moving);
            }
        }
        self.rows.push(moving);
    }

    /// Takes a value from each window, which must hold it: from its rank on, each value is replaced by the next one.
    fn remove(&mut self, leaving: &[f32; Self::COLUMNS]) {
        for rank in 1..self.rows.len() {
            let next = self.rows[rank];
            for ((value, next), leaving) in self.rows[rank - 1].iter_mut().zip(next).zip(leaving) {
                *value = if *value < *leaving { *value } else { next };
            }
        }
        self.rows.pop();
    }

    /// Removes a value and inserts another one in one pass.
    fn replace(&mut self, leaving: &[f32; Self::COLUMNS], mut moving: [f32; Self::COLUMNS]) {
        for rank in 1..self.rows.len() {
            let next = self.rows[rank];
            let columns = self.rows[rank - 1].iter_mut().zip(next).zip(leaving).zip(&mut moving);
            for (((value, next), leaving), moving) in columns {
                let kept = if *value < *leaving { *value } else { next };
                (*value, *moving) = ordered(kept, *moving);
            }
        }
        if let Some(last) = self.rows.last_mut() {
            *last = moving;
        }
    }

    fn medians(&self) -> &[f32; Self::COLUMNS] {
        &self.rows[self.rows.len() / 2]
    }
}

/// Returns the smaller and the larger one of two values. [`f32::min`] would check for NaN, which takes longer.
fn ordered(a: f32, b: f32) -> (f32, f32) {
    (if a < b { a } else { b }, if a < b { b } else { a })
}

/// Returns the middle value, or 0 if there are none. Reorders the values.
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
    fn windows_are_picked_from_as_one_by_one() {
        let (w, h) = (13, 7);
        let values: Vec<f32> = (0..w * h).map(|p| ((p * 37 + 11) % 91) as f32 - 45.0).collect();
        let image = Image { width: w, height: h, values };
        let within =
            |centre: usize, radius: usize, end: usize| centre.saturating_sub(radius)..(centre + radius + 1).min(end);
        for radius in [0, 1, 2, 3, 6, 20, usize::MAX / 2] {
            let picked = |x: usize, y: usize, first: f32, pick: fn(f32, f32) -> f32| {
                let rows = within(y, radius, h).flat_map(|y| within(x, radius, w).map(move |x| (x, y)));
                rows.map(|(x, y)| image.values[y * w + x]).fold(first, pick)
            };
            let (largest, min) = (dilate(&image, radius), filter(&image, radius, f32::INFINITY, f32::min));
            for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
                assert_eq!(
                    largest.values[y * w + x],
                    picked(x, y, f32::NEG_INFINITY, f32::max),
                    "{x}, {y} of {radius}"
                );
                assert_eq!(min.values[y * w + x], picked(x, y, f32::INFINITY, f32::min), "{x}, {y} of {radius}");
            }
        }
    }

    #[test]
    fn sorted_windows_have_the_median_of_their_values() {
        // More than the columns that are processed at once, and no multiple of them.
        let (w, h) = (SortedWindows::COLUMNS + 3, 7);
        let values: Vec<f32> = (0..w * h).map(|p| ((p * 37 + 11) % 17) as f32 - 8.0).collect();
        let image = Image { width: w, height: h, values };
        let of = |values: &[f32], centre: usize, radius: usize| {
            let mut window = values[centre.saturating_sub(radius)..(centre + radius + 1).min(values.len())].to_vec();
            median(&mut window)
        };
        for radius in [0, 1, 2, 6, 12, 20] {
            let rows: Vec<f32> = (0..w * h).map(|p| of(&image.values[p / w * w..][..w], p % w, radius)).collect();
            let column = |x: usize| (0..h).map(|y| rows[y * w + x]).collect::<Vec<f32>>();
            let expected: Vec<f32> = (0..w * h).map(|p| of(&column(p % w), p / w, radius)).collect();
            assert_eq!(median_filter(&image, radius).values, expected, "radius {radius}");
        }
    }

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
