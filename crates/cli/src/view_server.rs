//! The viewer's server: one page on this machine, on which the C-arm is turned with the mouse while the beat plays.
//!
//! It listens on 127.0.0.1 only. Every request needs the token of the printed address and a host name that is this machine's.
//! If the browser states the origin of a request, it must be the page itself.

use super::view_tree::TreeWork;
use axum::Router;
use axum::extract::{Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::png;
use nertca_vk::geometry::{CArm, Geometry, ViewRays};
use nertca_vk::model::Model;
use nertca_vk::render::quantity::Quantity;
use serde::Deserialize;
use serde_json::{Value, json};
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use subtle::ConstantTimeEq;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

const PAGE: &str = include_str!("view.html");
/// Script that draws trees, both on this page and in a report.
pub(super) const TREES_SCRIPT: &str = include_str!("trees.js");
/// Placeholder in the page that the script replaces.
const TREES_PLACE: &str = "/* trees.js */";
/// Allowed side of a picture, pixels.
const SIDES: std::ops::RangeInclusive<usize> = 16..=2048;
/// Side of the pictures that determine typical values, pixels.
pub const TYPICAL_SIDE: usize = 64;

/// Geometry of the angiograms, from which the viewer's pictures are derived.
#[derive(Debug, Clone)]
pub struct AngiogramGeometry {
    /// C-arm of the first view.
    pub c_arm: CArm,
    /// Number of columns and rows.
    pub image_size: [usize; 2],
}

impl AngiogramGeometry {
    /// Returns the side of the detector square that pictures show, mm.
    fn extent_mm(&self) -> f64 {
        let ([w, h], [across, down]) = (self.image_size, self.c_arm.pixel_mm);
        across.max(down) * w.max(h) as f64
    }

    /// Returns the rays of the C-arm at other angles, on a square of `side` pixels.
    ///
    /// # Errors
    /// [`Error::Config`] for invalid angles.
    pub fn turned(&self, primary_deg: f64, secondary_deg: f64, side: usize) -> Result<ViewRays> {
        let pixel_mm = [self.extent_mm() / side as f64; 2];
        let turned = CArm { primary_deg, secondary_deg, pixel_mm, table_mm: [0.0; 3], ..self.c_arm.clone() };
        Geometry::CArm(turned).rays(side, side).map_err(|(field, problem)| Error::config(field, "", problem))
    }
}

/// Source of a viewer's pictures.
pub trait PictureSource: Send + Sync {
    /// Returns the geometry of the angiograms.
    ///
    /// # Errors
    /// [`Error::NotReady`] before there is anything to show.
    fn taken(&self) -> Result<AngiogramGeometry>;

    /// Returns the number of cardiac phases.
    fn phases(&self) -> u32;

    /// Returns facts for the page, as a JSON object.
    fn about(&self) -> Value;

    /// Renders a square picture.
    ///
    /// # Errors
    /// [`Error::NotReady`] before there is anything to show; device errors.
    fn render(&self, rays: &ViewRays, side: usize, phase: u32, quantity: Quantity) -> Result<Vec<f32>>;

    /// Returns the largest value of a typical picture.
    ///
    /// # Errors
    /// Fails like [`PictureSource::render`].
    fn range(&self, quantity: Quantity, phase: u32) -> Result<f32>;

    /// Returns the current fields.
    ///
    /// # Errors
    /// Fails like [`PictureSource::render`].
    fn model(&self) -> Result<Model>;
}

struct Viewer {
    shown: Arc<dyn PictureSource>,
    /// Tree of the vessels, which is found when the page first requests it.
    tree: Arc<TreeWork>,
    token: String,
    port: u16,
}

/// Query of a picture.
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

/// Returns the value that a query names.
fn chosen<T: Choice>(field: &str, name: &str) -> Result<T> {
    T::named(name).ok_or_else(|| Error::config(field, name, format!("is not one of {}", T::names())))
}

impl Viewer {
    /// Draws a grey PNG with dark vessels, as in an angiogram. `low` and `high` are shares of the typical range.
    fn picture(&self, query: &PictureQuery) -> Result<Vec<u8>> {
        if !(query.low.is_finite() && query.high.is_finite() && query.low < query.high) {
            return Err(Error::config(
                "low, high",
                format!("{} to {}", query.low, query.high),
                "is not a valid window of intensities",
            ));
        }
        if !SIDES.contains(&query.size) {
            let problem = format!("is not in the accepted range, {} to {}", SIDES.start(), SIDES.end());
            return Err(Error::config("size", query.size, problem));
        }
        let quantity = Quantity {
            component: chosen("component", &query.component)?,
            projection: chosen("projection", &query.projection)?,
        };
        let rays = self.shown.taken()?.turned(query.primary, query.secondary, query.size)?;
        let values = self.shown.render(&rays, query.size, query.phase, quantity)?;
        let range = self.shown.range(quantity, query.phase)?;
        let (low, width) = (query.low * range, (query.high - query.low) * range);
        let codes: Vec<u8> = values.iter().map(|v| (255.0 * (1.0 - (v - low) / width)) as u8).collect();
        Ok(png::grey8(query.size, query.size, &codes)?)
    }
}

/// Tells whether a request comes from the printed page.
fn authorised(viewer: &Viewer, headers: &HeaderMap, query: &str) -> bool {
    let here = |name: &str| {
        [format!("127.0.0.1:{}", viewer.port), format!("localhost:{}", viewer.port)].iter().any(|h| h == name)
    };
    let text = |name: header::HeaderName| headers.get(name).and_then(|v| v.to_str().ok());
    // With a foreign host name, the request comes from a page whose own name was made to resolve to this address (DNS
    // rebinding).
    let host = text(header::HOST).is_some_and(here);
    let origin = text(header::ORIGIN).is_none_or(|o| o.strip_prefix("http://").is_some_and(here));
    let site = headers.get("sec-fetch-site").and_then(|v| v.to_str().ok());
    let site = site.is_none_or(|s| ["same-origin", "none"].contains(&s));
    let token = query.split('&').find_map(|pair| pair.strip_prefix("token=")).unwrap_or_default();
    // The comparison takes constant time, so that its duration reveals nothing about the token.
    let same = token.as_bytes().ct_eq(viewer.token.as_bytes());
    host && origin && site && bool::from(same)
}

async fn guard(State(viewer): State<Arc<Viewer>>, request: Request, next: Next) -> Response {
    let query = request.uri().query().unwrap_or_default().to_owned();
    if !authorised(&viewer, request.headers(), &query) {
        return (StatusCode::FORBIDDEN, "open the address that this program printed\n").into_response();
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
    let mut about = viewer.shown.about();
    about["phases"] = json!(viewer.shown.phases());
    about["tree"] = json!(viewer.tree.generation());
    if let Ok(taken) = viewer.shown.taken() {
        about["primary"] = json!(taken.c_arm.primary_deg);
        about["secondary"] = json!(taken.c_arm.secondary_deg);
        about["c_arm"] = json!({
            "sid_mm": taken.c_arm.sid_mm,
            "sod_mm": taken.c_arm.sod_mm,
            "offset_mm": taken.c_arm.offset_mm,
            "extent_mm": taken.extent_mm(),
        });
    }
    json_answer(about.to_string())
}

fn json_answer(text: String) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], text).into_response()
}

/// Returns the tree, or its progress; the first request starts the search.
async fn tree(State(viewer): State<Arc<Viewer>>) -> Response {
    let (answer, first) = viewer.tree.ask();
    if let Some(generation) = first {
        tokio::task::spawn_blocking(move || viewer.tree.find(generation, viewer.shown.model()));
    }
    json_answer(answer)
}

async fn frame(State(viewer): State<Arc<Viewer>>, Query(query): Query<PictureQuery>) -> Response {
    let drawn = tokio::task::spawn_blocking(move || viewer.picture(&query)).await;
    match drawn {
        Ok(Ok(png)) => ([(header::CONTENT_TYPE, "image/png")], png).into_response(),
        Ok(Err(error @ Error::Config { .. })) => (StatusCode::BAD_REQUEST, format!("{error}\n")).into_response(),
        Ok(Err(error @ Error::NotReady(_))) => (StatusCode::SERVICE_UNAVAILABLE, format!("{error}\n")).into_response(),
        Ok(Err(error)) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
    }
}

/// A server that is listening.
pub struct Server {
    runtime: Runtime,
    listener: TcpListener,
    viewer: Arc<Viewer>,
}

impl Server {
    /// Listens on a port of 127.0.0.1; 0 selects a free port.
    ///
    /// # Errors
    /// [`Error::Io`] for a port that is in use.
    pub fn open(port: u16, shown: Arc<dyn PictureSource>, tree: Arc<TreeWork>) -> Result<Server> {
        let mut secret = [0u8; 16];
        getrandom::fill(&mut secret)
            .map_err(|e| Error::Internal(format!("random numbers could not be obtained: {e}")))?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .map_err(Error::io("start", "the server"))?;
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
        let failed = || Error::io("listen on", address.to_string());
        let listener = runtime.block_on(TcpListener::bind(address)).map_err(failed())?;
        let port = listener.local_addr().map_err(failed())?.port();
        let token = secret.iter().map(|b| format!("{b:02x}")).collect();
        Ok(Server { runtime, listener, viewer: Arc::new(Viewer { shown, tree, token, port }) })
    }

    /// Returns the address of the page.
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/?token={}", self.viewer.port, self.viewer.token)
    }

    /// Serves the page until `end` completes.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn serve(self, end: impl Future<Output = ()> + Send + 'static) -> Result<()> {
        let Server { runtime, listener, viewer } = self;
        let app = Router::new()
            .route("/", get(|| async { Html(PAGE.replace(TREES_PLACE, TREES_SCRIPT)) }))
            .route("/info", get(info))
            .route("/frame", get(frame))
            .route("/tree", get(tree))
            .layer(middleware::from_fn_with_state(viewer.clone(), guard))
            .with_state(viewer.clone());
        let served = axum::serve(listener, app).with_graceful_shutdown(async move {
            end.await;
            viewer.tree.stop();
        });
        runtime.block_on(served.into_future()).map_err(Error::io("serve", "the viewer's page"))
    }
}
