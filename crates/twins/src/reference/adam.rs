//! f64 reference implementation (twin) of Adam (Kingma and Ba 2014, algorithm 1), which all kernels that update parameters share.

/// Constants of one Adam update.
#[derive(Debug, Clone, Copy)]
pub struct Adam {
    betas: [f64; 2],
    epsilon: f64,
    bias_corrections: [f64; 2],
}

impl Adam {
    /// Returns the update of a kernel with these constants. The bias corrections are 1 minus the powers of the betas.
    pub fn new(betas: [f32; 2], epsilon: f32, bias_corrections: [f32; 2]) -> Adam {
        Adam {
            betas: betas.map(f64::from),
            epsilon: f64::from(epsilon),
            bias_corrections: bias_corrections.map(f64::from),
        }
    }

    /// Updates a parameter and its first and second moment by the gradient `g`.
    pub fn update(&self, rate: f64, g: f64, parameter: &mut f64, moments: &mut [f64; 2]) {
        let [beta1, beta2] = self.betas;
        moments[0] = beta1 * moments[0] + (1.0 - beta1) * g;
        moments[1] = beta2 * moments[1] + (1.0 - beta2) * g * g;
        let [first, second] = [0, 1].map(|k| moments[k] / self.bias_corrections[k]);
        *parameter -= rate * first / (second.sqrt() + self.epsilon);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_update_goes_one_rate_against_the_gradient() {
        let adam = Adam::new([0.9, 0.99], 0.0, [0.1, 0.01]);
        for g in [-3.0, 1e-4, 20.0] {
            let (mut p, mut moments) = (5.0, [0.0; 2]);
            adam.update(0.25, g, &mut p, &mut moments);
            assert!((p - (5.0 - 0.25 * f64::signum(g))).abs() < 1e-6, "{g}: {p}");
        }
    }
}
