//! Pictures for visual inspection. Vessels are dark, as on an angiogram.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::png;
use crate::render::renderer::Rendering;
use crate::scan::dataset::Frame;
use image::{DynamicImage, Rgb, RgbImage};
use std::path::Path;

/// Minimum side of a panel; smaller images are enlarged by an integer factor.
const PANEL_PIXELS: usize = 200;
const GAP: usize = 4;
/// Window of images with a range from 0 to 1.
const NORMALISED: Window = Window { low: 0.0, high: 1.0 };

/// Window of displayed line integrals: `low` is white, `high` black.
#[derive(Debug, Clone, Copy)]
pub struct Window {
    /// Value shown white.
    pub low: f32,
    /// Value shown black.
    pub high: f32,
}

impl Window {
    /// Window of an image's range.
    pub fn of(values: &[f32]) -> Window {
        let (low, high) = values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        Window { low, high: if high > low { high } else { low + 1.0 } }
    }

    /// Grey code of a value.
    pub fn code(&self, value: f32) -> u8 {
        (255.0 * (1.0 - ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0))) as u8
    }

    /// Grey codes of an image.
    pub fn codes(&self, values: &[f32]) -> Vec<u8> {
        values.iter().map(|v| self.code(*v)).collect()
    }
}

/// Enlarges an image of `pixels` colours.
fn panel(width: usize, colour: impl Fn(usize) -> Rgb<u8>, pixels: usize) -> RgbImage {
    let height = pixels / width;
    let factor = PANEL_PIXELS.div_ceil(width.min(height)).max(1);
    RgbImage::from_fn((width * factor) as u32, (height * factor) as u32, |x, y| {
        colour(y as usize / factor * width + x as usize / factor)
    })
}

fn beside(panels: &[RgbImage]) -> RgbImage {
    let height = panels.iter().map(RgbImage::height).max().unwrap_or(1);
    let width: u32 = panels.iter().map(|p| p.width() + GAP as u32).sum::<u32>().saturating_sub(GAP as u32);
    let mut out = RgbImage::from_pixel(width.max(1), height, Rgb([255, 255, 255]));
    let mut x = 0;
    for p in panels {
        image::imageops::replace(&mut out, p, i64::from(x), 0);
        x += p.width() + GAP as u32;
    }
    out
}

/// Writes truth, prediction, static field, dynamic field, and the vessel mask over the truth: overlap green, missed red,
/// added blue.
///
/// # Errors
/// [`Error::Io`].
pub fn write_comparison(path: &Path, frame: &Frame, seen: &Rendering, threshold: f64, width: usize) -> Result<()> {
    let window = Window::of(&frame.integrals);
    let grey = |values: &[f32], window: Window| {
        let codes = window.codes(values);
        panel(width, |i| Rgb([codes[i]; 3]), values.len())
    };
    let codes = window.codes(&frame.integrals);
    let overlay = panel(
        width,
        |i| {
            let truth = frame.mask.as_ref().is_some_and(|m| m[i]);
            let found = f64::from(seen.dynamic_max[i]) > threshold;
            let base = codes[i] / 2 + 100;
            match (truth, found) {
                (true, true) => Rgb([base / 3, 200, base / 3]),
                (true, false) => Rgb([230, base / 4, base / 4]),
                (false, true) => Rgb([base / 3, base / 3, 230]),
                (false, false) => Rgb([base; 3]),
            }
        },
        frame.integrals.len(),
    );
    let picture = beside(&[
        grey(&frame.integrals, window),
        grey(&seen.total_integral(), if seen.is_blended { NORMALISED } else { window }),
        grey(&seen.static_integral, window),
        grey(&seen.dynamic_integral, Window { low: 0.0, ..Window::of(&seen.dynamic_integral) }),
        overlay,
    ]);
    Ok(png::write(path, &DynamicImage::ImageRgb8(picture))?)
}

/// Writes an image, and a copy with the region that the hull covers in orange, where vessels may be. A vessel outside is
/// lost.
///
/// # Errors
/// [`Error::Io`].
pub fn write_hull(path: &Path, integrals: &[f32], covered: &[bool], width: usize) -> Result<()> {
    let codes = Window::of(integrals).codes(integrals);
    let plain = panel(width, |i| Rgb([codes[i]; 3]), codes.len());
    let tinted = |i: usize| if covered[i] { Rgb([240, codes[i] / 2 + 100, codes[i] / 3]) } else { Rgb([codes[i]; 3]) };
    Ok(png::write(path, &DynamicImage::ImageRgb8(beside(&[plain, panel(width, tinted, codes.len())])))?)
}

/// Writes a looping animation of grey images, `width` columns each, `ms` milliseconds apart.
///
/// # Errors
/// [`Error::Io`] or [`Error::Internal`].
pub fn write_gif(path: &Path, frames: &[Vec<f32>], width: usize, window: Window, ms: u32) -> Result<()> {
    use image::codecs::gif::{GifEncoder, Repeat};
    let mut bytes = Vec::new();
    {
        let mut encoder = GifEncoder::new(&mut bytes);
        let fault = |e: image::ImageError| Error::Internal(format!("encoding {}: {e}", path.display()));
        encoder.set_repeat(Repeat::Infinite).map_err(fault)?;
        for values in frames {
            let codes = window.codes(values);
            let picture = panel(width, |i| Rgb([codes[i]; 3]), values.len());
            let delay = image::Delay::from_numer_denom_ms(ms, 1);
            let rgba = DynamicImage::ImageRgb8(picture).to_rgba8();
            encoder.encode_frame(image::Frame::from_parts(rgba, 0, 0, delay)).map_err(fault)?;
        }
    }
    Ok(files::write_atomic(path, &bytes)?)
}

/// Writes the vessel pixels of a view before and after a correction, side by side: green where the other views show vessels
/// on the ray as well, red where they do not.
///
/// # Errors
/// [`Error::Io`].
pub fn write_silhouettes(
    path: &Path,
    seen: &[f32],
    shown: &[bool],
    explained: [&[bool]; 2],
    width: usize,
) -> Result<()> {
    let window = Window::of(seen);
    let codes = window.codes(seen);
    let side = |explained: &[bool]| {
        let colour = |i: usize| match (shown[i], explained[i]) {
            (false, _) => Rgb([codes[i]; 3]),
            (true, true) => Rgb([30, 150, 60]),
            (true, false) => Rgb([220, 40, 30]),
        };
        panel(width, colour, seen.len())
    };
    Ok(png::write(path, &DynamicImage::ImageRgb8(beside(&explained.map(side))))?)
}

/// Writes one grey image.
///
/// # Errors
/// [`Error::Io`].
pub fn write_grey(path: &Path, values: &[f32], width: usize, window: Window) -> Result<()> {
    let codes = window.codes(values);
    Ok(png::write(path, &DynamicImage::ImageRgb8(panel(width, |i| Rgb([codes[i]; 3]), values.len())))?)
}
