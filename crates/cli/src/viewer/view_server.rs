//! The viewer's server: one page on this machine, on which the C-arm is turned with the mouse while the beat plays.
//!
//! It listens on 127.0.0.1 only. Every request needs the token of the printed address and a host name that is this machine's.
//! If the browser states the origin of a request, it must be the page itself.

use crate::viewer::view_tree::TreeWork;
use axum::Router;
use axum::extract::{Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::png;
use nertca_vk::geometry::{CArm, Geometry, ViewRays};
use nertca_vk::model::Model;
use nertca_vk::render::quantity::Quantity;
use nertca_vk_vessels::trees::tree::BeatTree;
use serde::Deserialize;
use serde_json::{Value, json};
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use subtle::ConstantTimeEq;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;

const PAGE: &str = include_str!("view.html");
/// Script that draws trees, both on this page and in a report.
pub(crate) const TREES_SCRIPT: &str = include_str!("trees.js");
/// Placeholder in the page that the script replaces.
const TREES_PLACE: &str = "/* trees.js */";
/// Allowed side of a picture, pixels.
const SIDES: std::ops::RangeInclusive<usize> = 16..=2048;
/// Pictures that are drawn at once: the device draws one while the processor packs another. Further ones wait their turn.
const PICTURES_AT_ONCE: usize = 2;
/// Connections that are open at once; a browser opens six.
const MAX_CONNECTIONS: usize = 64;
/// Time within which a client must send the head of its next request, or its connection is closed; the page opens another one.
const HEADERS_WITHIN: Duration = Duration::from_secs(5);
/// Time that requests under way have to finish at the end, and pictures after them.
const ENDS_WITHIN: Duration = Duration::from_secs(2);
/// Pause after a connection could not be accepted.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
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

    /// States in a tree what depends on the images of the training views, where they are known.
    fn compare_with_images(&self, beat: &mut BeatTree);
}

struct Viewer {
    shown: Arc<dyn PictureSource>,
    /// Tree of the vessels, which is found when the page first requests it.
    tree: Arc<TreeWork>,
    /// Turns of pictures to be drawn.
    turns: Arc<Semaphore>,
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
        tokio::task::spawn_blocking(move || {
            let shown = &viewer.shown;
            viewer.tree.find(generation, shown.model(), |beat| shown.compare_with_images(beat));
        });
    }
    json_answer(answer)
}

/// Query for the next view.
#[derive(Debug, Deserialize)]
struct NextViewQuery {
    /// Branch that is looked at; all of them by default.
    branch: Option<usize>,
}

/// Returns the positions of the C-arm for the next view, in the format that `next --json` prints.
async fn next_view(State(viewer): State<Arc<Viewer>>, Query(query): Query<NextViewQuery>) -> Response {
    let planned = tokio::task::spawn_blocking(move || {
        let taken = viewer.shown.taken()?;
        let plan = viewer.tree.next_view((&taken.c_arm, taken.image_size), query.branch)?;
        serde_json::to_string(&plan).map_err(|e| Error::Internal(e.to_string()))
    });
    match planned.await {
        Ok(Ok(plan)) => json_answer(plan),
        Ok(Err(error)) => refusal(&error),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
    }
}

/// Returns the answer to a request that failed.
fn refusal(error: &Error) -> Response {
    let code = match error {
        Error::Config { .. } => StatusCode::BAD_REQUEST,
        Error::NotReady(_) => StatusCode::SERVICE_UNAVAILABLE,
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    };
    (code, format!("{error}\n")).into_response()
}

/// Draws a picture when its turn comes. When a client leaves, the server drops this future, so a picture that nobody waits for any
/// more is not begun.
async fn frame(State(viewer): State<Arc<Viewer>>, Query(query): Query<PictureQuery>) -> Response {
    let turn = viewer.turns.clone().acquire_owned().await;
    let drawn = tokio::task::spawn_blocking(move || {
        let _turn = turn;
        viewer.picture(&query)
    });
    match drawn.await {
        Ok(Ok(png)) => ([(header::CONTENT_TYPE, "image/png")], png).into_response(),
        Ok(Err(error)) => refusal(&error),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
    }
}

/// A server that is listening.
pub struct Server {
    runtime: Runtime,
    /// Places of connections.
    room: Arc<Semaphore>,
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
        let turns = Arc::new(Semaphore::new(PICTURES_AT_ONCE));
        let token = secret.iter().map(|b| format!("{b:02x}")).collect();
        let room = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        Ok(Server { runtime, room, listener, viewer: Arc::new(Viewer { shown, tree, turns, token, port }) })
    }

    /// Returns the address of the page.
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/?token={}", self.viewer.port, self.viewer.token)
    }

    /// Serves the page until `end` completes, and then lets requests under way finish for a moment.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn serve(self, end: impl Future<Output = ()> + Send + 'static) -> Result<()> {
        let Server { runtime, room, listener, viewer } = self;
        let app = Router::new()
            .route("/", get(|| async { Html(PAGE.replace(TREES_PLACE, TREES_SCRIPT)) }))
            .route("/info", get(info))
            .route("/frame", get(frame))
            .route("/tree", get(tree))
            .route("/next", get(next_view))
            .layer(middleware::from_fn_with_state(viewer.clone(), guard))
            .with_state(viewer.clone());
        let ended = async move {
            end.await;
            viewer.tree.stop();
        };
        runtime.block_on(answer_until(ended, room, listener, app));
        // A picture that is being drawn ends by itself; one that hangs in the driver does not hold the program up.
        runtime.shutdown_timeout(ENDS_WITHIN);
        Ok(())
    }
}

/// Answers connections until `ended` completes.
async fn answer_until(ended: impl Future<Output = ()>, room: Arc<Semaphore>, listener: TcpListener, app: Router) {
    let mut connections = JoinSet::new();
    // Connections end when the sender is dropped.
    let (open, closing) = watch::channel(());
    let accepting = async {
        loop {
            // Without room, further clients wait to be accepted.
            let Ok(place) = room.clone().acquire_owned().await else { return };
            match listener.accept().await {
                Ok((stream, _)) => {
                    let answered = answer(stream, app.clone(), closing.clone());
                    connections.spawn(async move {
                        let _place = place;
                        answered.await;
                    });
                }
                // Such as too many open files: that passes.
                Err(_) => tokio::time::sleep(ACCEPT_AGAIN).await,
            }
            while connections.try_join_next().is_some() {}
        }
    };
    tokio::select! {
        () = ended => (),
        () = accepting => (),
    }
    drop(open);
    // What is left then is dropped with the connections.
    let _ = tokio::time::timeout(ENDS_WITHIN, async { while connections.join_next().await.is_some() {} }).await;
}

/// Answers the requests of a connection until it ends, or `closing` does.
async fn answer(stream: TcpStream, app: Router, mut closing: watch::Receiver<()>) {
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADERS_WITHIN)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(app));
    let mut connection = std::pin::pin!(connection);
    tokio::select! {
        // A client that breaks its connection off is no error of the server.
        _ = connection.as_mut() => return,
        _ = closing.changed() => connection.as_mut().graceful_shutdown(),
    }
    let _ = connection.await;
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;
    use nertca_vk::gpu::device::{DeviceOptions, Gpu};
    use nertca_vk::kernels::tuning::Tuning;
    use std::io::{Read, Write};
    use std::net::TcpStream;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::mpsc::{Receiver, Sender, channel};

    /// A source that tells when it begins a picture, and then waits until it may go on.
    struct Held {
        begun: Sender<()>,
        goes_on: Mutex<Receiver<()>>,
        drawn: AtomicUsize,
    }

    impl PictureSource for Held {
        fn taken(&self) -> Result<AngiogramGeometry> {
            let c_arm = CArm {
                primary_deg: 0.0,
                secondary_deg: 0.0,
                sid_mm: 1000.0,
                sod_mm: 700.0,
                pixel_mm: [1.0; 2],
                offset_mm: [0.0; 2],
                table_mm: [0.0; 3],
            };
            Ok(AngiogramGeometry { c_arm, image_size: [16, 16] })
        }

        fn phases(&self) -> u32 {
            1
        }

        fn about(&self) -> Value {
            json!({})
        }

        fn render(&self, _: &ViewRays, side: usize, _: u32, _: Quantity) -> Result<Vec<f32>> {
            self.drawn.fetch_add(1, Ordering::SeqCst);
            self.begun.send(()).unwrap();
            self.goes_on.lock().unwrap().recv().unwrap();
            Ok(vec![0.0; side * side])
        }

        fn range(&self, _: Quantity, _: u32) -> Result<f32> {
            Ok(1.0)
        }

        fn model(&self) -> Result<Model> {
            Err(Error::NotReady("there is no model".into()))
        }

        fn compare_with_images(&self, _: &mut BeatTree) {}
    }

    #[test]
    fn pictures_whose_clients_have_left_are_not_drawn() {
        let gpu = Gpu::open(&DeviceOptions::default()).unwrap();
        let tuning = Tuning::for_device(gpu.info());
        let ((begun, begins), (release, goes_on)) = (channel(), channel());
        let held = Arc::new(Held { begun, goes_on: Mutex::new(goes_on), drawn: AtomicUsize::new(0) });
        let server = Server::open(0, held.clone(), Arc::new(TreeWork::new(&gpu, tuning))).unwrap();
        let (port, room) = (server.viewer.port, server.room.clone());
        let picture = format!(
            "GET /frame?token={}&primary=0&secondary=0&phase=0&component=total&projection=drr&size=16&low=0&high=1 \
             HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n",
            server.viewer.token
        );
        let (end, ended) = tokio::sync::oneshot::channel::<()>();
        let serving = std::thread::spawn(move || server.serve(async { drop(ended.await) }));
        let ask = || {
            let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
            stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
            stream.write_all(picture.as_bytes()).unwrap();
            stream
        };
        let mut first: Vec<TcpStream> = (0..PICTURES_AT_ONCE).map(|_| ask()).collect();
        (0..PICTURES_AT_ONCE).for_each(|_| begins.recv().unwrap());
        let abandoned: Vec<TcpStream> = (0..20).map(|_| ask()).collect();
        let open = |connections: usize| {
            while room.available_permits() != MAX_CONNECTIONS - connections {
                std::thread::sleep(Duration::from_millis(5));
            }
        };
        // One place is kept for the next client.
        open(PICTURES_AT_ONCE + abandoned.len() + 1);
        drop(abandoned);
        open(PICTURES_AT_ONCE + 1);
        let mut last = ask();
        (0..PICTURES_AT_ONCE + 1).for_each(|_| release.send(()).unwrap());
        for stream in first.iter_mut().chain([&mut last]) {
            let mut answer = Vec::new();
            stream.read_to_end(&mut answer).unwrap();
            assert!(answer.starts_with(b"HTTP/1.1 200"));
        }
        assert_eq!(held.drawn.load(Ordering::SeqCst), PICTURES_AT_ONCE + 1, "those that someone waits for");
        drop(end);
        serving.join().unwrap().unwrap();
    }
}
