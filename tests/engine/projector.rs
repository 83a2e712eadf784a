//! Comparison of the device's projector with the f64 one.

use crate::common::{expect_agreement, expect_silence, gpu};
use nertca_vk_twins::selftest::projections;

#[test]
fn device_and_f64_projector_agree() {
    let gpu = gpu();
    expect_agreement(|findings| projections::compare(&gpu, findings));
    expect_silence(gpu);
}
