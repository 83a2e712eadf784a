//! Vessels that are known before, in a session: its fits are those of a run with the same prior.

use crate::adjustment::{session_with, views_that_agree};
use crate::common::{expect_silence, gpu, run, tuning};
use nertca_vk::calibrate::calibrate;
use nertca_vk::config::{Config, Preset};
use nertca_vk::gaussians::field::GaussianField;
use nertca_vk::plan::Plan;
use nertca_vk::scan::prior::VesselPrior;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::selftest::problems::with_values;
use std::sync::Arc;

#[test]
fn a_session_fits_as_a_run_with_the_same_prior() {
    const ITERATIONS: u32 = 10;
    let gpu = gpu();
    let shot = views_that_agree();
    // A short preparation: the fields are compared with each other alone.
    let short = ["gaussians.fits=1", "deformable.warm_iterations=20", "deformable.track_iterations=5"];
    let config = with_values(&Config::preset(Preset::Fast), short).unwrap();
    let prior = VesselPrior { shapes_mm: vec![shot.points_mm(0)] };
    let of_session = |prior: Option<VesselPrior>| -> GaussianField {
        let session = session_with(&gpu, shot, config.clone());
        session.set_prior(prior).unwrap();
        assert_eq!(session.train(ITERATIONS, &mut |_| true).unwrap(), ITERATIONS);
        let gaussians = session.checkpoint().unwrap().model.gaussians;
        session.stop().unwrap();
        gaussians.unwrap()
    };
    let of_run = |prior: VesselPrior| -> GaussianField {
        let mut dataset = shot.dataset.clone();
        dataset.prior = Some(Arc::new(prior));
        let dataset = dataset.corrected(&calibrate(&dataset, config.calibration()).unwrap()).unwrap();
        let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
        run(&mut trainer, ITERATIONS);
        trainer.model().unwrap().gaussians.unwrap()
    };
    let with = of_session(Some(prior.clone()));
    assert_eq!(with, of_run(prior));
    assert_ne!(with, of_session(None), "the prior changes the seeds");
    expect_silence(gpu);
}
