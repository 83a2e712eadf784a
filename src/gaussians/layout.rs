//! Structures shared with the shaders; `glsl/inc/gaussian.glsl` is the other half, and a test compares the two.

use bytemuck::{Pod, Zeroable};

macro_rules! shared {
    ($(#[$doc:meta])* $name:ident { $($(#[$about:meta])* $field:ident : $ty:ty),* $(,)? }) => {
        $(#[$doc])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
        pub struct $name { $($(#[$about])* pub $field: $ty),* }

        #[cfg(test)]
        impl $name {
            const FIELDS: &'static [(&'static str, &'static str)] = &[$((stringify!($field), stringify!($ty))),*];
        }
    };
}

shared! {
    /// One Gaussian: attenuation exp(log_density - |diag(1 / scale) R^T (x - position)|^2 / 2).
    Gaussian {
        /// Centre, pixels at the isocentre along the world's axes.
        position: [f32; 3],
        /// Log of the attenuation at the centre, shares of the strongest change per pixel at the isocentre.
        log_density: f32,
        /// Logs of the standard deviations along its own axes, pixels at the isocentre.
        log_scale: [f32; 3],
        /// Cardiac phase it belongs to.
        phase: u32,
        /// Quaternion (w, x, y, z) of its axes; its length does not matter.
        rotation: [f32; 4],
    }
}

shared! {
    /// A view as the shaders see it.
    GaussianView {
        /// Row of the homogeneous projection that gives the depth.
        depth: [f32; 4],
        /// Row that gives depth times column.
        column: [f32; 4],
        /// Row that gives depth times row.
        row: [f32; 4],
        /// Direction of pixel (0, 0)'s ray, of unit depth; then 1 / |det (d0, du, dv)|.
        d0: [f32; 4],
        /// Its change per column.
        du: [f32; 4],
        /// Its change per row.
        dv: [f32; 4],
    }
}

shared! {
    /// What stays fixed during a run.
    GaussianSetup {
        /// Training views.
        n_views: u32,
        /// Cardiac phases.
        n_phases: u32,
        /// Columns of an image.
        width: u32,
        /// Rows of an image.
        height: u32,
        /// Standard deviations at which a Gaussian ends.
        cut: f32,
        /// Least scale, pixels.
        least_scale: f32,
        /// Greatest scale, pixels.
        greatest_scale: f32,
        /// Units of the integer sums per unit of line integral.
        fixed_point: f32,
        /// Where the loss bends from square to linear, shares of the strongest change.
        bend: f32,
        /// Factor on the loss.
        loss_weight: f32,
        /// Adam's decay of the first moment.
        beta1: f32,
        /// Adam's decay of the second moment.
        beta2: f32,
        /// Adam's guard against division by zero.
        epsilon: f32,
        /// Adam's rate of positions, pixels.
        position_rate: f32,
        /// Adam's rate of log-scales.
        scale_rate: f32,
        /// Adam's rate of quaternions.
        rotation_rate: f32,
        /// Adam's rate of log-densities.
        density_rate: f32,
        /// Losses kept.
        ring_length: u32,
        /// Images.
        n_images: u32,
        /// Numbers from one image to the next: pixels, filled up to groups of four.
        image_stride: u32,
        /// Partial sums of the loss.
        n_loss_parts: u32,
        /// Blur of images and Gaussians, pixels; for tracking motion. Gradients of scales do not know of it.
        blur: f32,
    }
}

shared! {
    /// One row per iteration.
    GaussianSchedule {
        /// Factor on all rates.
        rate: f32,
        /// 1 - beta1 to the power of updates.
        bias1: f32,
        /// 1 - beta2 to the power of updates.
        bias2: f32,
        /// Unused.
        spare: f32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `(name, type)` of each field of `struct NAME` in the GLSL file, in Rust's spelling.
    fn glsl_fields(name: &str) -> Vec<(String, String)> {
        let source = include_str!("../../glsl/inc/gaussian.glsl");
        let body = source.split(&format!("struct {name} {{")).nth(1).unwrap().split("};").next().unwrap();
        body.lines()
            .filter_map(|line| line.split("//").next().unwrap().trim().strip_suffix(';'))
            .map(|line| {
                let (ty, field) = line.split_once(' ').unwrap();
                let ty = match ty {
                    "uint" => "u32",
                    "float" => "f32",
                    "vec3" => "[f32; 3]",
                    "vec4" => "[f32; 4]",
                    other => panic!("type {other} has no Rust twin here"),
                };
                (field.trim().to_owned(), ty.to_owned())
            })
            .collect()
    }

    #[test]
    fn structures_match_the_shaders() {
        for (name, fields) in [
            ("Gaussian", Gaussian::FIELDS),
            ("GaussianView", GaussianView::FIELDS),
            ("GaussianSetup", GaussianSetup::FIELDS),
            ("GaussianSchedule", GaussianSchedule::FIELDS),
        ] {
            let rust: Vec<_> = fields.iter().map(|(n, t)| ((*n).to_owned(), (*t).to_owned())).collect();
            assert_eq!(glsl_fields(name), rust, "struct {name}");
        }
    }
}
