//! Live pictures follow a run: volumes and kept images of the static field are those of its present iteration once they were renewed.

use crate::common::{expect_silence, gpu, small_config, small_dataset, tuning};
use nertca_vk::model::component::Component;
use nertca_vk::plan::Plan;
use nertca_vk::render::live::{Live, Refresh, Source};
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::train::trainer::Trainer;

const SHOWN: Quantity = Quantity { component: Component::Total, projection: Projection::Drr };
const BEHIND: Quantity = Quantity { component: Component::Static, projection: Projection::Drr };
/// More pixels than a strip that is drawn beside pictures.
const SIZE: (usize, usize) = (200, 100);
/// Share of the largest value by which an image in strips, whose rays start at other rows, may differ.
const TOLERANCE: f32 = 1e-4;

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    let largest = b.iter().fold(0.0, |max: f32, v| max.max(v.abs()));
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / largest
}

#[test]
fn images_of_the_static_field_are_renewed_beside_pictures() {
    let gpu = gpu();
    let dataset = small_dataset(16, 16);
    let config = small_config("fast", &["train.iterations=40", "gaussians.iterations=4"]);
    let vessels = config.gaussian_iterations();
    let plan = Plan::new(&config, &dataset).unwrap();
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    let rays = &dataset.views[0].rays;
    let source = |trainer: &Trainer| Source { outline: trainer.outline(), feed: trainer.feed() };
    let live = Live::new(&gpu, &source(&trainer), tuning(&gpu), None).unwrap();
    let draw =
        |live: &Live, step: u32, quantity| live.render((step, Refresh::Beside), rays, SIZE, 1.0, quantity).unwrap();
    let train_to = |trainer: &mut Trainer, step: u32| {
        while trainer.step() < step {
            trainer.advance(step).unwrap();
        }
    };

    train_to(&mut trainer, 1);
    let first = draw(&live, 1, SHOWN);
    let behind = draw(&live, 1, BEHIND);
    assert_eq!(live.shown_step(1, 1.0, SHOWN), 1);
    train_to(&mut trainer, vessels);
    assert_eq!(draw(&live, vessels, BEHIND), behind);
    assert_eq!(live.shown_step(vessels, 1.0, BEHIND), vessels, "the static field is the same until its own fit begins");

    train_to(&mut trainer, 40);
    assert_eq!(draw(&live, 40, BEHIND), behind, "it is shown as it was until it is renewed");
    assert_eq!(live.shown_step(40, 1.0, SHOWN), 1);
    live.refresh_all_beside(40).unwrap();
    let anew = Live::new(&gpu, &source(&trainer), tuning(&gpu), None).unwrap();
    let (wanted, wanted_behind) = (draw(&anew, 40, SHOWN), draw(&anew, 40, BEHIND));
    assert!(largest_difference(&first, &wanted) > 0.01, "training changed the picture");
    assert!(largest_difference(&draw(&live, 40, SHOWN), &wanted) < TOLERANCE);
    assert!(largest_difference(&draw(&live, 40, BEHIND), &wanted_behind) < TOLERANCE);
    assert_eq!(live.shown_step(40, 1.0, SHOWN), 40);
    let other = Live::new(&gpu, &source(&trainer), tuning(&gpu), None).unwrap();
    other.bake_like(&live, 40).unwrap();
    assert!(largest_difference(&draw(&other, 40, SHOWN), &wanted) < TOLERANCE, "prepared from another source");
    drop((live, anew, other, trainer));
    expect_silence(gpu);
}
