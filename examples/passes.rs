use nertca_vk::{
    config::Config,
    data::dataset::Dataset,
    gpu::device::*,
    train::{plan::Plan, trainer::Trainer},
};
use std::collections::BTreeMap;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let d = Dataset::open(args[1].as_ref()).unwrap();
    let c = Config::load(None, None, &args[2..]).unwrap();
    let plan = Plan::new(&c, &d).unwrap();
    println!("{:?}", plan.notes);
    let gpu = Gpu::open(&DeviceOptions::default()).unwrap();
    let mut t = Trainer::new(&gpu, plan, &d).unwrap();
    t.profile_step().unwrap();
    let mut sums: BTreeMap<&str, f64> = BTreeMap::new();
    let n = 8;
    let s = std::time::Instant::now();
    for _ in 0..n {
        for p in t.profile_step().unwrap() {
            *sums.entry(p.name).or_default() += p.ms / n as f64;
        }
    }
    println!("profiled {:.1} ms/it", s.elapsed().as_secs_f64() * 1e3 / n as f64);
    let mut v: Vec<_> = sums.into_iter().collect();
    v.sort_by(|a, b| b.1.total_cmp(&a.1));
    for (k, m) in &v {
        println!("{k:32} {m:8.3}");
    }
    println!("sum {:.2}", v.iter().map(|x| x.1).sum::<f64>());
    let s = std::time::Instant::now();
    let a = t.step();
    let mut l = vec![];
    while t.step() < a + 32 {
        l = t.advance(a + 32).unwrap();
    }
    println!("plain {:.1} ms/it {:?}", s.elapsed().as_secs_f64() * 1e3 / 32.0, l.last());
}
