//! Canvas for images of different sizes: each image is placed in the upper left corner of a canvas that holds all of them.
//! Rays begin at pixel (0, 0), so they are the same on the canvas. Pixels beyond an image are hidden, like those behind a
//! blade.

use crate::raster::Image;
use crate::scan::dataset::{Dataset, Frame, View};
use crate::scan::frame_checks::Complaint;
use std::borrow::Cow;

/// Largest accepted number of pixels of all images together once they are extended to a larger canvas.
const MAX_PIXELS: usize = 1 << 30;

/// Returns the upper left corner of `size` (columns, rows) of an array with `width` columns.
pub fn corner<T: Copy>(values: &[T], width: usize, [columns, rows]: [usize; 2]) -> Vec<T> {
    values.chunks(width).take(rows).flat_map(|row| &row[..columns]).copied().collect()
}

/// Places an array of `size` (columns, rows) in the upper left corner of a canvas, with `margin` elsewhere.
pub fn framed<T: Copy>(values: &[T], [columns, rows]: [usize; 2], [width, height]: [usize; 2], margin: T) -> Vec<T> {
    let mut canvas = vec![margin; width * height];
    for (to, from) in canvas.chunks_mut(width).zip(values.chunks(columns)).take(rows) {
        to[..columns].copy_from_slice(from);
    }
    canvas
}

/// Extends an image to a canvas (columns, rows) by repeating its right and lower edges.
pub fn continued(image: Image, [width, height]: [usize; 2]) -> Image {
    if (image.width, image.height) == (width, height) {
        return image;
    }
    let nearest = |p: usize| (p / width).min(image.height - 1) * image.width + (p % width).min(image.width - 1);
    Image { width, height, values: (0..width * height).map(|p| image.values[nearest(p)]).collect() }
}

/// Extends frames from the sizes of their views to a canvas that holds all of them. Returns the canvas (columns, rows), or none
/// without frames.
pub fn onto_canvas(views: &[View], frames: &mut [Frame]) -> Result<Option<[usize; 2]>, Complaint> {
    let sizes = || frames.iter().map(|frame| views[frame.view].size);
    let Some(canvas) = sizes().reduce(|a, b| [a[0].max(b[0]), a[1].max(b[1])]) else { return Ok(None) };
    if sizes().all(|size| size == canvas) {
        return Ok(Some(canvas));
    }
    let [width, height] = canvas;
    if frames.len() * width * height > MAX_PIXELS {
        let value = format!("{} images, of which the largest has {width} columns and {height} rows", frames.len());
        let problem = format!(
            "would have more than {MAX_PIXELS} pixels in total if all had the largest size: reduce the large images"
        );
        return Err(Complaint::new("size", value, problem));
    }
    for frame in frames {
        let size = views[frame.view].size;
        let image = Image { width: size[0], height: size[1], values: std::mem::take(&mut frame.integrals).into_vec() };
        frame.integrals = continued(image, canvas).values.into();
        frame.mask = frame.mask.take().map(|mask| framed(&mask, size, canvas, false));
    }
    Ok(Some(canvas))
}

impl Dataset {
    /// Columns and rows of the canvas.
    pub fn canvas(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Returns the part of canvas values that lies within a view's image.
    pub fn own<'a, T: Copy>(&self, view: usize, values: &'a [T]) -> Cow<'a, [T]> {
        let size = self.views[view].size;
        if size == self.canvas() { Cow::Borrowed(values) } else { Cow::Owned(corner(values, self.width, size)) }
    }

    /// Returns a frame cropped to the size of its view's images, as it was taken.
    pub fn own_frame<'a>(&self, frame: &'a Frame) -> Cow<'a, Frame> {
        if self.views[frame.view].size == self.canvas() {
            return Cow::Borrowed(frame);
        }
        Cow::Owned(Frame {
            name: frame.name.clone(),
            integrals: self.own(frame.view, &frame.integrals).into_owned().into(),
            mask: frame.mask.as_ref().map(|mask| self.own(frame.view, mask).into_owned()),
            ..*frame
        })
    }

    /// Sizes (columns, rows) of the images, each once, in the order of the views.
    pub fn sizes(&self) -> Vec<[usize; 2]> {
        let mut sizes: Vec<[usize; 2]> = Vec::new();
        for view in &self.views {
            if !sizes.contains(&view.size) {
                sizes.push(view.size);
            }
        }
        sizes
    }
}

/// Formats sizes (columns, rows) for messages.
pub fn in_words(sizes: &[[usize; 2]]) -> String {
    sizes.iter().map(|[columns, rows]| format!("{columns} x {rows}")).collect::<Vec<_>>().join(" and ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_stand_in_the_corner_and_go_on_at_their_edges() {
        let image = Image { width: 2, height: 2, values: vec![1.0, 2.0, 3.0, 4.0] };
        let canvas = continued(image.clone(), [4, 3]);
        assert_eq!(canvas.values, [1.0, 2.0, 2.0, 2.0, 3.0, 4.0, 4.0, 4.0, 3.0, 4.0, 4.0, 4.0]);
        assert_eq!(corner(&canvas.values, 4, [2, 2]), image.values);
        let mask = framed(&[true; 4], [2, 2], [3, 3], false);
        assert_eq!(mask, [true, true, false, true, true, false, false, false, false]);
        assert_eq!(corner(&mask, 3, [2, 2]), [true; 4]);
    }
}
