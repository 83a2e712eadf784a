//! Trees as shown to users: over the viewer's pictures and on a run's page, in a browser controlled by a script.

use crate::known_tree::{PHASES, Trained, ok, text, train, trained};
use crate::program::{program, whole_config};
use crate::python::python;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::config::Preset;
use nertca_vk::geometry::{CArm, Geometry, ViewRays, world_from_lps_mm};
use nertca_vk::scan::dataset::Dataset;
use nertca_vk_runs::run::score::as_trained;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Duration;

/// Side of the viewer's finest picture, pixels.
const SIDE: usize = 420;

type Line = Vec<[f64; 3]>;

/// The viewer's process, until it is dropped.
pub struct Server {
    process: Child,
    /// Address of the page.
    pub url: String,
}

impl Server {
    pub fn of(run: &Path) -> Server {
        let mut process =
            program().args(["view", text(run)]).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut url = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut url).unwrap();
        Server { process, url: url.trim().to_owned() }
    }

    /// Body of a response, which must be successful.
    fn ask(&self, path: &str) -> Vec<u8> {
        let (host, token) = self.url.strip_prefix("http://").unwrap().split_once("/?token=").unwrap();
        let mut stream = TcpStream::connect(host).unwrap();
        write!(stream, "GET {path}token={token} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        assert!(answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer));
        let split = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        answer[split + 4..].to_vec()
    }

    /// Result of the tree's extraction.
    fn tree(&self) -> Value {
        loop {
            let answer: Value = serde_json::from_slice(&self.ask("/tree?")).unwrap();
            if answer["state"] != "working" {
                return answer;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }
}

/// Lines of a tree's file at a phase, which may lie between two.
fn lines(tree: &Value, phase: f64) -> Vec<Line> {
    let of = |phase: usize| -> Vec<Line> {
        let branches = tree["phases"][phase % PHASES]["branches"].as_array().unwrap();
        branches.iter().map(|b| serde_json::from_value(b["points_mm"].clone()).unwrap()).collect()
    };
    let (before, share) = (phase as usize, phase.fract());
    let between = |(a, b): (&[f64; 3], &[f64; 3])| [0, 1, 2].map(|i| a[i] + share * (b[i] - a[i]));
    let line = |(a, b): (&Line, &Line)| a.iter().zip(b).map(between).collect();
    of(before).iter().zip(&of(before + 1)).map(line).collect()
}

fn seen(rays: &ViewRays, line: &Line) -> Vec<(f64, f64)> {
    line.iter().map(|point| rays.project(world_from_lps_mm((*point).into())).unwrap()).collect()
}

pub fn python_test(script: &str, args: &[&Path]) {
    let script = crate::root::root().join("tests/python").join(script);
    let outcome = python().arg(script).args(args).output().unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}

#[test]
fn the_viewer_draws_the_tree_where_the_engine_sees_it() {
    let (directory, Trained { run, .. }) = (tempfile::tempdir().unwrap(), trained());
    let [file, expected, shot] = ["seen.json", "expected.json", "viewer.png"].map(|name| directory.path().join(name));
    ok(&["tree", text(run), "-o", text(&file)]);
    let tree: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let model = newest_model(run).unwrap();
    let (c_arm, [width, height]) = (&model.c_arm, model.image_size);
    let pixel_mm = c_arm.pixel_mm[0].max(c_arm.pixel_mm[1]) * width.max(height) as f64 / SIDE as f64;
    let rays = |primary_deg: f64, secondary_deg: f64| {
        let turned = CArm { primary_deg, secondary_deg, pixel_mm: [pixel_mm; 2], table_mm: [0.0; 3], ..c_arm.clone() };
        Geometry::CArm(turned).rays(SIDE, SIDE).unwrap()
    };
    let angles_and_phases =
        [(30.0, 25.0, 1.0), (-45.5, -20.0, 2.5), (90.0, 0.0, 3.75), (-170.0, 80.0, 0.25), (40.0, 10.0, 1.0)];
    let case = |(primary, secondary, phase): (f64, f64, f64)| {
        let rays = rays(primary, secondary);
        let lines: Vec<_> = lines(&tree, phase).iter().map(|line| seen(&rays, line)).collect();
        json!({ "state": { "primary": primary, "secondary": secondary, "phase": phase }, "lines": lines })
    };
    let server = Server::of(run);
    let cases = angles_and_phases.map(case);
    let all = json!({ "url": server.url, "tree": file, "cases": cases });
    std::fs::write(&expected, all.to_string()).unwrap();
    python_test("check_viewer.py", &[&expected, &shot]);
    // The picture shows vessels at the positions of the lines.
    let query = format!("primary=40&secondary=10&phase=1&component=dynamic&projection=drr&size={SIDE}&low=0&high=1");
    let picture = image::load_from_memory(&server.ask(&format!("/frame?{query}&"))).unwrap().to_luma8();
    let rays = rays(40.0, 10.0);
    let points: Vec<_> = lines(&tree, 1.0).iter().flat_map(|line| seen(&rays, line)).collect();
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
    let on = |(i, j): &(f64, f64)| f64::from(picture[(i.round() as u32, j.round() as u32)].0[0]);
    let (lines, all) = (mean(points.iter().map(on).collect()), mean(picture.iter().map(|v| f64::from(*v)).collect()));
    assert!(lines < 150.0 && all > 235.0, "grey is {lines:.0} under the lines and {all:.0} everywhere");
    assert_eq!(server.tree()["tree"], tree, "the page has what the file has");
    for branch in [&[][..], &["--branch", "0"]] {
        let (printed, _) = ok(&[&["next", text(run), "--json"], branch].concat());
        let query = if branch.is_empty() { "/next?" } else { "/next?branch=0&" };
        let answer: Value = serde_json::from_slice(&server.ask(query)).unwrap();
        assert_eq!(answer, serde_json::from_str::<Value>(&printed).unwrap(), "the page has what the command prints");
        assert!(answer["suggested"][0]["doubt_removed"].as_f64().unwrap() > 0.0, "{}", answer["suggested"][0]);
    }
}

#[test]
fn viewer_and_page_say_why_there_is_no_tree() {
    let (directory, Trained { data, .. }) = (tempfile::tempdir().unwrap(), trained());
    // A network that starts at zero, and is not trained yet, has no vessels.
    let young = directory.path().join("young");
    let nothing = ["dynamic.best_start=false", "dynamic.normalised_shift=-15"];
    let config = whole_config(directory.path(), Preset::FastMlp, &nothing);
    train(data, &young, &["--config", text(&config), "--iterations", "1", "--tree"]);
    let page = std::fs::read_to_string(young.join("report.html")).unwrap();
    assert!(
        page.contains("The vessel tree could not be extracted") && !page.contains("<script"),
        "a page without a tree says so"
    );
    assert!(!young.join("tree.json").exists());
    let answer = Server::of(&young).tree();
    assert_eq!(answer["state"], "failed");
    let problem = answer["problem"].as_str().unwrap();
    assert!(problem.contains("no vessel") && problem.contains("phase 0"), "{problem}");
}

#[test]
fn the_page_of_a_run_draws_the_tree_over_its_angiograms() {
    let (directory, Trained { data, run, .. }) = (tempfile::tempdir().unwrap(), trained());
    let [expected, shot] = ["page.json", "page.png"].map(|name| directory.path().join(name));
    let tree: Value = serde_json::from_slice(&std::fs::read(run.join("tree.json")).unwrap()).unwrap();
    let dataset = as_trained(Dataset::open(data).unwrap(), run).unwrap();
    let views = dataset.training_views().into_iter().map(|view| {
        let frames = dataset.training().iter().filter(|frame| frame.view == view);
        let frames = frames.map(|frame| {
            let rays = dataset.heart_rays(frame);
            let lines: Vec<_> = lines(&tree, f64::from(frame.phase)).iter().map(|line| seen(&rays, line)).collect();
            json!({ "phase": frame.phase, "lines": lines, "integrals": *frame.integrals })
        });
        frames.collect::<Vec<_>>()
    });
    let all = json!({
        "page": run.join("report.html"), "tree": run.join("tree.json"), "views": views.collect::<Vec<_>>(),
    });
    std::fs::write(&expected, all.to_string()).unwrap();
    python_test("check_tree_page.py", &[&expected, &shot]);
    // On a second request it is the same; without a request it is absent.
    let again = directory.path().join("again");
    ok(&["eval", text(run), "--images", text(&again), "--tree"]);
    assert_eq!(std::fs::read(again.join("tree.json")).unwrap(), std::fs::read(run.join("tree.json")).unwrap());
    assert!(std::fs::read_to_string(again.join("report.html")).unwrap().contains("tree-data"));
    // The run's own page is that of the last test that requests it.
    let without = directory.path().join("without");
    ok(&["eval", text(run), "--images", text(&without)]);
    assert!(!std::fs::read_to_string(without.join("report.html")).unwrap().contains("<script"));
}

#[test]
fn scores_of_the_tree_are_those_of_scipy() {
    let (directory, Trained { data, run, .. }) = (tempfile::tempdir().unwrap(), trained());
    let out = directory.path().join("scored");
    let said = ok(&["eval", text(run), "--images", text(&out), "--tree", "--json"]).0;
    std::fs::write(out.join("evaluation.json"), &said).unwrap();
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("Scores of the tree"));
    assert!(
        ok(&["eval", text(run), "--tree"]).0.contains("vessel tree is compared with the true one"),
        "there is a table"
    );
    python_test("check_tree_scores.py", &[data, &out]);
    // Without a request, or without a truth, there are none.
    let untold: Value = serde_json::from_str(&ok(&["eval", text(run), "--json"]).0).unwrap();
    assert!(untold.get("tree").is_none() && untold.get("volume").is_some());
}
