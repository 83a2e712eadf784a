//! Twin of the stages that compare pictures: an absolute difference and SSIM, with their gradient (Wang et al. 2004).

/// Half length of SSIM's window, without the middle.
const REACH: i64 = 5;
/// Standard deviation of SSIM's window, pixels.
const DEVIATION: f64 = 1.5;
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Filters an image with SSIM's window along lines of `length` pixels, `step` apart in memory, with zeros outside.
fn along_lines(image: &[f64], step: usize, length: usize) -> Vec<f64> {
    let weight = |k: i64| (-0.5 * (k as f64 / DEVIATION).powi(2)).exp();
    let all: f64 = (-REACH..=REACH).map(weight).sum();
    let at = |p: usize| {
        let place = (p / step % length) as i64;
        let inside = (-REACH..=REACH).filter(|k| (0..length as i64).contains(&(place + k)));
        inside.map(|k| weight(k) / all * image[(p as i64 + k * step as i64) as usize]).sum()
    };
    (0..image.len()).map(at).collect()
}

/// Filters an image with SSIM's window along rows.
pub fn along_rows(image: &[f64], width: usize) -> Vec<f64> {
    along_lines(image, 1, width)
}

/// Filters an image with SSIM's window.
fn windowed(image: &[f64], width: usize) -> Vec<f64> {
    along_lines(&along_rows(image, width), width, image.len() / width)
}

/// SSIM at each pixel of images with a range from 0 to 1, and the factors P, Q and T of its gradient.
pub fn ssim(x: &[f64], y: &[f64], width: usize) -> (Vec<f64>, [Vec<f64>; 3]) {
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<f64>>();
    let [m1, m2, xx, yy, xy] =
        [x.to_vec(), y.to_vec(), product(x, x), product(y, y), product(x, y)].map(|image| windowed(&image, width));
    let (mut values, mut factors) = (Vec::new(), [Vec::new(), Vec::new(), Vec::new()]);
    for p in 0..x.len() {
        let (a1, a2) = (2.0 * m1[p] * m2[p] + C1, 2.0 * (xy[p] - m1[p] * m2[p]) + C2);
        let b1 = m1[p] * m1[p] + m2[p] * m2[p] + C1;
        let b2 = xx[p] - m1[p] * m1[p] + yy[p] - m2[p] * m2[p] + C2;
        let v = a1 * a2 / (b1 * b2);
        values.push(v);
        factors[0].push(2.0 * m2[p] * (a2 - a1) / (b1 * b2) + 2.0 * m1[p] * v * (1.0 / b2 - 1.0 / b1));
        factors[1].push(-v / b2);
        factors[2].push(2.0 * a1 / (b1 * b2));
    }
    (values, factors)
}

/// Mean of |x - y| + weight (1 - SSIM), and its gradient by x.
pub fn picture_loss(x: &[f64], y: &[f64], width: usize, weight: f64) -> (f64, Vec<f64>) {
    let n = x.len() as f64;
    let (values, factors) = ssim(x, y, width);
    let [p, q, t] = factors.map(|factor| windowed(&factor, width));
    let loss: f64 = (0..x.len()).map(|i| (x[i] - y[i]).abs() + weight * (1.0 - values[i])).sum();
    let sign = |d: f64| if d == 0.0 { 0.0 } else { d.signum() };
    let slope = |i: usize| (sign(x[i] - y[i]) - weight * (p[i] + 2.0 * x[i] * q[i] + y[i] * t[i])) / n;
    (loss / n, (0..x.len()).map(slope).collect())
}
