//! OpenIGTLink for `watch`: the overlay, its place in space and the vessels, to any number of clients. A slow client misses pictures; it
//! delays neither the others nor the training. A client that sends the place of its C-arm gets the picture from there, as all others do.

use crate::viewer::view_server::PictureSource;
use crate::viewer::view_tree::TreeWork;
use glam::{DMat3, DVec3};
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::igtl::{self, Picture, Received, ras};
use nertca_vk::geometry::{MM_PER_UNIT, ViewRays, angles_deg_of, lps_mm_from_world, world_from_lps_mm};
use nertca_vk::model::component::Component;
use nertca_vk::render::quantity::{Projection, Quantity};
use serde::Deserialize;
use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

/// Interval of the pictures.
const PICTURE_EVERY: Duration = Duration::from_millis(50);
/// Interval at which clients are accepted, and at which what is not there yet is asked for again.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Longest time that a client may take for a message.
const SENT_WITHIN: Duration = Duration::from_secs(10);
/// Greatest number of clients.
const MAX_CLIENTS: usize = 16;
/// Greatest number of reads of what a client sends, between two pictures.
const MAX_READS: usize = 16;
/// Columns and rows of the overlay.
const SIDE: u16 = 256;
/// Maximum deviation of the length of a direction that a client sends from 1.
const UNIT_WITHIN: f64 = 0.05;
/// Type of the message with the place of a C-arm.
const TRANSFORM: &str = "TRANSFORM";
/// Names of the devices.
const OVERLAY: &str = "Overlay";
const C_ARM: &str = "CArm";
const VESSELS: &str = "Vessels";

/// The newest messages.
#[derive(Default)]
struct Newest {
    /// Number of the picture.
    number: u64,
    bytes: Arc<Vec<u8>>,
}

/// Place of a C-arm.
#[derive(Clone, Copy)]
struct Turned {
    /// Address of the client that sent it.
    by: SocketAddr,
    primary_deg: f64,
    secondary_deg: f64,
}

/// State that the threads share.
#[derive(Default)]
struct Shared {
    newest: Mutex<Newest>,
    changed: Condvar,
    /// Place of the C-arm that a connected client sent last; the pictures are those of the first view where there is none.
    turned: Mutex<Option<Turned>>,
    clients: AtomicUsize,
    ended: AtomicBool,
}

impl Shared {
    fn newest(&self) -> MutexGuard<'_, Newest> {
        self.newest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn turned(&self) -> MutexGuard<'_, Option<Turned>> {
        self.turned.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Acquire)
    }

    /// Draws the pictures from the place of a C-arm that a client has sent, until it leaves. Returns false for a place that is none; other
    /// messages are ignored.
    fn follow(&self, by: SocketAddr, message: &Received) -> bool {
        if message.kind != TRANSFORM || message.device != C_ARM {
            return true;
        }
        let angles_deg = igtl::read_transform(&message.content).and_then(|[_, _, away, _]| angles_along(away));
        let Some([primary_deg, secondary_deg]) = angles_deg else { return false };
        *self.turned() = Some(Turned { by, primary_deg, secondary_deg });
        true
    }

    /// Forgets the place of the C-arm that a client has sent.
    fn forget(&self, client: SocketAddr) {
        self.turned().take_if(|turned| turned.by == client);
    }
}

/// A server that sends pictures until it is dropped.
pub struct IgtlServer {
    shared: Arc<Shared>,
    threads: Vec<std::thread::JoinHandle<()>>,
    address: SocketAddr,
}

impl IgtlServer {
    /// Opens the port and begins to send what a source shows.
    ///
    /// # Errors
    /// [`Error::Config`] for an address that cannot be used, such as a port in use.
    pub fn open(at: (IpAddr, u16), source: Arc<dyn PictureSource>, tree: Arc<TreeWork>) -> Result<IgtlServer> {
        let unusable = |error: std::io::Error| {
            let problem = format!("cannot be used: {error}; choose another port, or 0 for a free one");
            Error::config("--igtl", SocketAddr::from(at), problem)
        };
        let listener = TcpListener::bind(at).map_err(unusable)?;
        let address = listener.local_addr().map_err(unusable)?;
        listener.set_nonblocking(true).map_err(unusable)?;
        let shared = Arc::<Shared>::default();
        let (accepting, drawing) = (shared.clone(), shared.clone());
        let threads = vec![
            std::thread::spawn(move || accept(&listener, &accepting)),
            std::thread::spawn(move || Beat { source, tree, vessels: None }.draw(&drawing)),
        ];
        Ok(IgtlServer { shared, threads, address })
    }

    /// Returns the address that clients connect to.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for IgtlServer {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Release);
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has told so.
            let _ = thread.join();
        }
    }
}

/// Accepts clients until the end, and waits for those that are connected.
fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    let mut threads = Vec::new();
    while !shared.has_ended() {
        match listener.accept() {
            Ok((stream, from)) if shared.clients.load(Ordering::Acquire) < MAX_CLIENTS => {
                tracing::info!("OpenIGTLink: {from} is connected");
                shared.clients.fetch_add(1, Ordering::AcqRel);
                let (shared, own) = (shared.clone(), stream.try_clone());
                let thread = std::thread::spawn(move || {
                    let why = serve(stream, from, &shared).err().map_or("end".into(), |error| error.to_string());
                    shared.forget(from);
                    shared.clients.fetch_sub(1, Ordering::AcqRel);
                    tracing::info!("OpenIGTLink: {from} is disconnected: {why}");
                });
                threads.push((own, thread));
            }
            Ok((_, from)) => eprintln!("warning: OpenIGTLink: {from} is refused: {MAX_CLIENTS} clients are connected"),
            Err(_) => std::thread::sleep(LOOK_EVERY),
        }
        threads.retain(|(_, thread)| !thread.is_finished());
    }
    for (stream, thread) in threads {
        // The end does not wait for a client that takes nothing. It may be gone already.
        let _ = stream.map(|stream| stream.shutdown(Shutdown::Both));
        let _ = thread.join();
    }
}

/// Sends the newest messages to a client whenever there are new ones.
fn serve(mut stream: TcpStream, from: SocketAddr, shared: &Shared) -> std::io::Result<()> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(SENT_WITHIN))?;
    // The newest picture may be older than the connection.
    let mut sent = shared.newest().number;
    let mut reader = igtl::Reader::default();
    let mut has_warned = false;
    loop {
        let bytes = {
            let unchanged = |newest: &mut Newest| newest.number == sent && !shared.has_ended();
            let waited = shared.changed.wait_timeout_while(shared.newest(), LOOK_EVERY, unchanged);
            let (newest, _) = waited.unwrap_or_else(PoisonError::into_inner);
            if shared.has_ended() {
                return Ok(());
            }
            let is_new = newest.number != sent;
            sent = newest.number;
            is_new.then(|| newest.bytes.clone())
        };
        if let Some(bytes) = bytes {
            stream.write_all(&bytes)?;
        }
        let is_there = receive(&mut stream, &mut reader)?;
        while let Some(message) = reader.next_message() {
            // A client may send many of them per second.
            if !shared.follow(from, &message) && !std::mem::replace(&mut has_warned, true) {
                eprintln!(
                    "warning: OpenIGTLink: {TRANSFORM} {C_ARM} of {from} is ignored where its third column is no direction"
                );
            }
        }
        if !is_there {
            return Ok(());
        }
    }
}

/// Takes what a client has sent lately; returns whether it is still there.
fn receive(stream: &mut TcpStream, reader: &mut igtl::Reader) -> std::io::Result<bool> {
    let mut room = [0; 4096];
    stream.set_nonblocking(true)?;
    let mut there = Ok(true);
    // A client that sends without end is not listened to without end.
    for _ in 0..MAX_READS {
        match stream.read(&mut room) {
            Ok(0) => there = Ok(false),
            Ok(n) => {
                reader.push(&room[..n]);
                continue;
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) => there = Err(error),
        }
        break;
    }
    stream.set_nonblocking(false)?;
    there
}

/// Centrelines as the JSON of a tree states them.
#[derive(Deserialize)]
struct Answer {
    state: String,
    tree: Option<Lines>,
}

#[derive(Deserialize)]
struct Lines {
    phases: Vec<LinesOfPhase>,
}

#[derive(Deserialize)]
struct LinesOfPhase {
    phase: u32,
    branches: Vec<Branch>,
}

#[derive(Deserialize)]
struct Branch {
    points_mm: Vec<[f64; 3]>,
    radius_mm: Vec<f64>,
}

/// The pictures of a beat.
struct Beat {
    source: Arc<dyn PictureSource>,
    tree: Arc<TreeWork>,
    /// Vessels that were found, with their generation; none where the field has none.
    vessels: Option<(u64, Option<Lines>)>,
}

impl Beat {
    /// Draws pictures, one phase after the other, while clients are connected.
    fn draw(mut self, shared: &Shared) {
        let (mut phase, mut looked) = (0, Instant::now());
        while !shared.has_ended() {
            let begun = Instant::now();
            if shared.clients.load(Ordering::Acquire) == 0 {
                std::thread::sleep(LOOK_EVERY);
                continue;
            }
            if looked.elapsed() >= LOOK_EVERY {
                self.look_for_vessels();
                looked = Instant::now();
            }
            let turned = *shared.turned();
            match self.picture(phase, turned) {
                Ok(bytes) => {
                    let mut newest = shared.newest();
                    *newest = Newest { number: newest.number + 1, bytes: Arc::new(bytes) };
                    shared.changed.notify_all();
                }
                // There is nothing to show yet.
                Err(Error::NotReady(_)) => std::thread::sleep(LOOK_EVERY),
                Err(error) => {
                    tracing::warn!("OpenIGTLink: no picture: {error}");
                    std::thread::sleep(LOOK_EVERY);
                }
            }
            phase = (phase + 1) % self.source.phases().max(1);
            std::thread::sleep(PICTURE_EVERY.saturating_sub(begun.elapsed()));
        }
    }

    /// Takes over the vessels of the trained field, and has them found if nobody has.
    fn look_for_vessels(&mut self) {
        let generation = self.tree.generation();
        if self.vessels.as_ref().is_some_and(|(of, _)| *of == generation) {
            return;
        }
        self.vessels = None;
        if self.source.about()["state"] != "trained" {
            return;
        }
        let (answer, first) = self.tree.ask();
        if let Some(first) = first {
            let (tree, source) = (self.tree.clone(), self.source.clone());
            std::thread::spawn(move || tree.find(first, source.model(), |beat| source.compare_with_images(beat)));
        }
        let Ok(Answer { state, tree }) = serde_json::from_str(&answer) else { return };
        if state == "failed" {
            tracing::info!("OpenIGTLink: the field has no vessels to send: {answer}");
        }
        if state != "working" {
            self.vessels = Some((generation, tree));
        }
    }

    /// Returns the messages of a phase: the place of the C-arm, the overlay and the vessels. Pictures are those of the first view where no
    /// place is given.
    fn picture(&self, phase: u32, turned: Option<Turned>) -> Result<Vec<u8>> {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let taken = self.source.taken()?;
        let first = [taken.c_arm.primary_deg, taken.c_arm.secondary_deg];
        let [primary_deg, secondary_deg] = turned.map_or(first, |turned| [turned.primary_deg, turned.secondary_deg]);
        let rays = taken.turned(primary_deg, secondary_deg, usize::from(SIDE))?;
        let quantity = Quantity { component: Component::Dynamic, projection: Projection::Drr };
        let values = self.source.render(&rays, usize::from(SIDE), phase, quantity)?;
        let [axes, steps_mm] = placed(&rays);
        let picture = Picture {
            values: &values,
            size: [SIDE; 2],
            steps_mm: [steps_mm[0], steps_mm[1]],
            middle_mm: middle_mm(&rays),
        };
        let mut out = igtl::message(TRANSFORM, C_ARM, now, &igtl::transform(axes, picture.middle_mm));
        out.extend(igtl::message("IMAGE", OVERLAY, now, &igtl::image(&picture)));
        if let Some(body) = self.lines(phase) {
            out.extend(igtl::message("POLYDATA", VESSELS, now, &body));
        }
        Ok(out)
    }

    fn lines(&self, phase: u32) -> Option<Vec<u8>> {
        let lines = self.vessels.as_ref()?.1.as_ref()?;
        let LinesOfPhase { branches, .. } = lines.phases.iter().find(|of| of.phase == phase)?;
        let points = |branch: &Branch| branch.points_mm.iter().map(|p| ras(DVec3::from_array(*p))).collect();
        let points: Vec<Vec<DVec3>> = branches.iter().map(points).collect();
        let radii: Vec<f64> = branches.iter().flat_map(|branch| branch.radius_mm.iter().copied()).collect();
        Some(igtl::lines(points.iter().map(Vec::as_slice), "Radius", &radii))
    }
}

/// Returns the unit axes of a view (columns, rows, away from the source), and the steps of its pixels in the plane through the isocentre, mm;
/// RAS.
fn placed(rays: &ViewRays) -> [[DVec3; 3]; 2] {
    let [across, down] = [rays.anchor[1], rays.anchor[2]].map(|step| ras(lps_mm_from_world(step)));
    let away = ras(lps_mm_from_world(rays.axis()) / MM_PER_UNIT);
    let axes = DMat3::from_cols(across.normalize_or(DVec3::X), down.normalize_or(DVec3::Y), away);
    [[axes.x_axis, axes.y_axis, axes.z_axis], [across, down, away]]
}

/// Returns the primary and the secondary angle, deg, of a C-arm whose detector lies in a direction from its source, RAS; `None` for a vector
/// that is far from a unit one.
fn angles_along(away: DVec3) -> Option<[f64; 2]> {
    let is_direction = (away.length() - 1.0).abs() < UNIT_WITHIN;
    is_direction.then(|| angles_deg_of(world_from_lps_mm(ras(away)).normalize_or_zero()))
}

/// Returns the middle of a picture in the plane through the isocentre, RAS mm.
fn middle_mm(rays: &ViewRays) -> DVec3 {
    let half = 0.5 * f64::from(SIDE - 1);
    ras(lps_mm_from_world(rays.pixel(half, half).0))
}
