//! `view`: one page on this machine, on which the C-arm is turned with the mouse while the beat plays.
//!
//! Listens on 127.0.0.1 alone. Every request needs the token of the printed address, a host name that is this machine's,
//! and, where a browser says so, to come from the page itself.

use super::args::Cli;
use super::view_tree::TreeWork;
use axum::Router;
use axum::extract::{Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use clap::Args;
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::png;
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::model::Model;
use nertca_vk::model::checkpoint::newest_model;
use nertca_vk::model::component::Component;
use nertca_vk::render::baked::Baked;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use serde::Deserialize;
use std::collections::HashMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use subtle::ConstantTimeEq;

/// `view`.
#[derive(Debug, Args)]
pub struct ViewArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Port on 127.0.0.1; a free one by default.
    #[arg(long, default_value_t = 0)]
    pub port: u16,
}

const PAGE: &str = include_str!("view.html");
/// What draws trees, on this page and on that of a report.
pub(super) const TREES_SCRIPT: &str = include_str!("trees.js");
/// Where the page has it.
const TREES_PLACE: &str = "/* trees.js */";
/// Side of a picture, pixels.
const SIDES: std::ops::RangeInclusive<usize> = 16..=2048;
/// Side of a cell of the moving field: finer than a vessel, coarse enough to draw while dragging.
const CELL_MM: f64 = 0.5;

struct Viewer {
    model: Model,
    /// One picture at a time: they share the device.
    baked: Mutex<Baked>,
    /// The vessels as a tree, once the page asks for it.
    tree: TreeWork,
    /// Largest value of a typical view.
    ranges: HashMap<Quantity, f32>,
    token: String,
    port: u16,
}

/// What a picture shows.
#[derive(Debug, Deserialize)]
struct PictureQuery {
    primary: f64,
    secondary: f64,
    phase: u32,
    /// `total`, `static` or `dynamic`.
    component: String,
    /// `drr` or `mip`.
    projection: String,
    size: usize,
    low: f32,
    high: f32,
}

/// The value a query names.
fn chosen<T: Choice>(field: &str, name: &str) -> Result<T> {
    T::named(name).ok_or_else(|| Error::config(field, name, format!("one of {} is accepted", T::names())))
}

impl Viewer {
    /// Side of the square on the detector that pictures show, mm.
    fn extent_mm(&self) -> f64 {
        let [w, h] = self.model.image_size;
        let [across, down] = self.model.c_arm.pixel_mm;
        across.max(down) * w.max(h) as f64
    }

    fn values(&self, query: &PictureQuery) -> Result<(Vec<f32>, Quantity)> {
        if !SIDES.contains(&query.size) {
            let problem = format!("{} to {} is accepted", SIDES.start(), SIDES.end());
            return Err(Error::config("size", query.size, problem));
        }
        let quantity = Quantity {
            component: chosen("component", &query.component)?,
            projection: chosen("projection", &query.projection)?,
        };
        let c_arm = &self.model.c_arm;
        let pixel = self.extent_mm() / query.size as f64;
        let turned = CArm {
            primary_deg: query.primary,
            secondary_deg: query.secondary,
            pixel_mm: [pixel; 2],
            table_mm: [0.0; 3],
            ..c_arm.clone()
        };
        let rays = Geometry::CArm(turned)
            .rays(query.size, query.size)
            .map_err(|(field, problem)| Error::config(field, "", problem))?;
        let baked = self.baked.lock().unwrap_or_else(PoisonError::into_inner);
        Ok((baked.render(&rays, query.size, query.size, query.phase, quantity)?, quantity))
    }

    /// A grey PNG: vessels dark, as in an angiogram. `low` and `high` are shares of the typical range.
    fn picture(&self, query: &PictureQuery) -> Result<Vec<u8>> {
        if !(query.low.is_finite() && query.high.is_finite() && query.low < query.high) {
            return Err(Error::config("low, high", format!("{} to {}", query.low, query.high), "is no window"));
        }
        let (values, quantity) = self.values(query)?;
        let range = self.ranges.get(&quantity).copied().unwrap_or(1.0);
        let (low, width) = (query.low * range, (query.high - query.low) * range);
        let codes: Vec<u8> = values.iter().map(|v| (255.0 * (1.0 - (v - low) / width)) as u8).collect();
        png::grey8(query.size, query.size, &codes)
    }
}

/// Whether a request comes from the page that was printed.
fn authorised(viewer: &Viewer, headers: &HeaderMap, query: &str) -> bool {
    let here = |name: &str| {
        [format!("127.0.0.1:{}", viewer.port), format!("localhost:{}", viewer.port)].iter().any(|h| h == name)
    };
    let text = |name: header::HeaderName| headers.get(name).and_then(|v| v.to_str().ok());
    // A foreign name for this address would be a page that had its own name point here.
    let host = text(header::HOST).is_some_and(here);
    let origin = text(header::ORIGIN).is_none_or(|o| o.strip_prefix("http://").is_some_and(here));
    let site = headers.get("sec-fetch-site").and_then(|v| v.to_str().ok());
    let site = site.is_none_or(|s| ["same-origin", "none"].contains(&s));
    let token = query.split('&').find_map(|pair| pair.strip_prefix("token=")).unwrap_or_default();
    // In constant time, so that how long it takes tells nothing of how much was right.
    let same = token.as_bytes().ct_eq(viewer.token.as_bytes());
    host && origin && site && bool::from(same)
}

async fn guard(State(viewer): State<Arc<Viewer>>, request: Request, next: Next) -> Response {
    let query = request.uri().query().unwrap_or_default().to_owned();
    if !authorised(&viewer, request.headers(), &query) {
        return (StatusCode::FORBIDDEN, "open the address that `nertca-vk view` printed\n").into_response();
    }
    let mut response = next.run(request).await;
    for (name, value) in [
        (header::CACHE_CONTROL, "no-store"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'none'; img-src blob:; connect-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'",
        ),
    ] {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

async fn info(State(viewer): State<Arc<Viewer>>) -> Response {
    let m = &viewer.model;
    let described = serde_json::json!({
        "phases": m.param_map.phases,
        "primary": m.c_arm.primary_deg,
        "secondary": m.c_arm.secondary_deg,
        "c_arm": {
            "sid_mm": m.c_arm.sid_mm,
            "sod_mm": m.c_arm.sod_mm,
            "offset_mm": m.c_arm.offset_mm,
            "extent_mm": viewer.extent_mm(),
        },
        "step": m.step,
        "preset": m.config.preset.name(),
    });
    json(described.to_string())
}

fn json(text: String) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], text).into_response()
}

/// The tree, or how far it has come; who asks first sets it off.
async fn tree(State(viewer): State<Arc<Viewer>>) -> Response {
    let (answer, first) = viewer.tree.ask();
    if first {
        tokio::task::spawn_blocking(move || viewer.tree.find(&viewer.model));
    }
    json(answer)
}

async fn frame(State(viewer): State<Arc<Viewer>>, Query(query): Query<PictureQuery>) -> Response {
    let drawn = tokio::task::spawn_blocking(move || viewer.picture(&query)).await;
    match drawn {
        Ok(Ok(png)) => ([(header::CONTENT_TYPE, "image/png")], png).into_response(),
        Ok(Err(error @ Error::Config { .. })) => (StatusCode::BAD_REQUEST, format!("{error}\n")).into_response(),
        Ok(Err(error)) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
    }
}

/// Serves the page until Ctrl-C.
pub fn view(cli: &Cli, args: &ViewArgs) -> Result<()> {
    let model = newest_model(&args.run)?;
    let gpu = cli.open_device()?;
    let renderer = Arc::new(Renderer::new(&gpu, &model, cli.tuning(&gpu, &model.config))?);
    eprintln!("preparing {} phases on {} ...", model.param_map.phases, gpu.info().name);
    let baked = Baked::for_display(renderer, &model, CELL_MM);
    let mut secret = [0u8; 16];
    getrandom::fill(&mut secret).map_err(|e| Error::Internal(format!("random numbers: {e}")))?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(Error::io("start", "the server"))?;
    runtime.block_on(async {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, args.port));
        let listener =
            tokio::net::TcpListener::bind(address).await.map_err(Error::io("listen on", address.to_string()))?;
        let port = listener.local_addr().map_err(Error::io("listen on", address.to_string()))?.port();
        let mut viewer = Viewer {
            tree: TreeWork::new(&gpu, cli.tuning(&gpu, &model.config)),
            model,
            baked: Mutex::new(baked),
            ranges: HashMap::new(),
            token: secret.iter().map(|b| format!("{b:02x}")).collect(),
            port,
        };
        viewer.ranges = typical_ranges(&viewer)?;
        out!("http://127.0.0.1:{port}/?token={}", viewer.token);
        let viewer = Arc::new(viewer);
        let app = Router::new()
            .route("/", get(|| async { Html(PAGE.replace(TREES_PLACE, TREES_SCRIPT)) }))
            .route("/info", get(info))
            .route("/frame", get(frame))
            .route("/tree", get(tree))
            .layer(middleware::from_fn_with_state(viewer.clone(), guard))
            .with_state(viewer.clone());
        axum::serve(listener, app)
            .with_graceful_shutdown(async move {
                // Without a handler there is no Ctrl-C to wait for: the process then ends at once.
                let _ = tokio::signal::ctrl_c().await;
                viewer.tree.stop();
            })
            .await
            .map_err(Error::io("serve", address.to_string()))
    })?;
    drop(runtime);
    cli.close_device(&gpu)
}

/// Largest value of each kind of picture from the model's own angle; also bakes every phase.
fn typical_ranges(viewer: &Viewer) -> Result<HashMap<Quantity, f32>> {
    let mut ranges = HashMap::new();
    for &component in Component::ALL {
        // The still background is the same at every phase.
        let phases = if component.has_dynamic() { viewer.model.param_map.phases as u32 } else { 1 };
        for &projection in Projection::ALL {
            let mut most = f32::MIN_POSITIVE;
            for phase in 0..phases {
                let query = PictureQuery {
                    primary: viewer.model.c_arm.primary_deg,
                    secondary: viewer.model.c_arm.secondary_deg,
                    phase,
                    component: component.name().into(),
                    projection: projection.name().into(),
                    size: 64,
                    low: 0.0,
                    high: 1.0,
                };
                most = viewer.values(&query)?.0.into_iter().fold(most, f32::max);
            }
            ranges.insert(Quantity { component, projection }, most);
        }
    }
    Ok(ranges)
}
