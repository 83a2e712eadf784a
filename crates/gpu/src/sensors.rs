//! Reads clock, power and temperature of a device during a measurement, where the system provides them: `nvidia-smi` of
//! NVIDIA's driver, the `amdgpu` driver's files, `/proc/cpuinfo` for the host's own processor.

use crate::capabilities::DeviceInfo;
use serde::{Deserialize, Serialize};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Time from one reading to the next.
const PAUSE: Duration = Duration::from_millis(500);
/// Longest wait for a program's output.
const PATIENCE: Duration = Duration::from_secs(3);
/// Directory in which Linux lists graphics devices.
const DRM: &str = "/sys/class/drm";

/// One reading of a device's sensors; values that the system does not provide are none.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Reading {
    /// Clock of the compute units, MHz.
    pub clock_mhz: Option<f64>,
    /// Power drawn, W.
    pub power_w: Option<f64>,
    /// Temperature, degrees Celsius.
    pub temperature_c: Option<f64>,
}

/// Minimum, mean and maximum of a quantity; reports keep their first names.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Span {
    /// Minimum.
    #[serde(rename = "least")]
    pub min: f64,
    /// Mean.
    pub mean: f64,
    /// Maximum.
    #[serde(rename = "greatest")]
    pub max: f64,
}

/// Summary of a device's readings during a measurement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Readings {
    /// Name of the source of the readings.
    pub source: String,
    /// Number of readings, two per second.
    pub count: usize,
    /// Clock of the compute units, MHz.
    pub clock_mhz: Option<Span>,
    /// Power drawn, W.
    pub power_w: Option<Span>,
    /// Temperature, degrees Celsius.
    pub temperature_c: Option<Span>,
}

/// Source of a device's readings.
#[derive(Debug, Clone, PartialEq)]
enum Source {
    NvidiaSmi { uuid: String },
    AmdGpu { directory: PathBuf },
    CpuInfo,
}

impl Source {
    /// Returns the source that can read the device's sensors, if there is one.
    fn of(info: &DeviceInfo) -> Option<Source> {
        let name = format!("{} {}", info.name, info.driver).to_lowercase();
        let source = if info.is_cpu() {
            Some(Source::CpuInfo)
        } else if name.contains("nvidia") {
            nvidia_uuid(&info.uuid).map(|uuid| Source::NvidiaSmi { uuid })
        } else if name.contains("amd") || name.contains("radeon") {
            the_only_amdgpu(Path::new(DRM)).map(|directory| Source::AmdGpu { directory })
        } else {
            None
        };
        source.filter(|source| source.read().is_some())
    }

    fn name(&self) -> &'static str {
        match self {
            Source::NvidiaSmi { .. } => "nvidia-smi",
            Source::AmdGpu { .. } => "amdgpu",
            Source::CpuInfo => "/proc/cpuinfo",
        }
    }

    fn read(&self) -> Option<Reading> {
        match self {
            Source::NvidiaSmi { uuid } => read_nvidia(uuid),
            Source::AmdGpu { directory } => read_amdgpu(directory),
            Source::CpuInfo => cpu_clock(&std::fs::read_to_string("/proc/cpuinfo").ok()?),
        }
    }
}

/// Returns a device's UUID as NVIDIA's tools write it, from 32 hexadecimal digits.
fn nvidia_uuid(digits: &str) -> Option<String> {
    let part = |from: usize, to: usize| digits.get(from..to);
    let (a, b, c, d, e) = (part(0, 8)?, part(8, 12)?, part(12, 16)?, part(16, 20)?, part(20, 32)?);
    Some(format!("GPU-{a}-{b}-{c}-{d}-{e}"))
}

fn read_nvidia(uuid: &str) -> Option<Reading> {
    let query = ["--query-gpu=clocks.sm,power.draw,temperature.gpu", "--format=csv,noheader,nounits"];
    let mut command = Command::new("nvidia-smi");
    command.arg(format!("--id={uuid}")).args(query).stdout(Stdio::piped()).stderr(Stdio::null());
    nvidia_line(&output_within(command, PATIENCE)?)
}

/// Returns the output of a command, if it succeeds in time: the command may hang when a driver does. The output must fit in a
/// pipe.
fn output_within(mut command: Command, patience: Duration) -> Option<String> {
    let mut child = command.spawn().ok()?;
    let end = Instant::now() + patience;
    let status = loop {
        match child.try_wait().ok()? {
            Some(status) => break status,
            None if Instant::now() < end => std::thread::sleep(PAUSE / 50),
            None => {
                // The command was killed or had already ended; in both cases there is no output to read.
                let _ = child.kill();
                return None;
            }
        }
    };
    let mut text = String::new();
    child.stdout.take()?.read_to_string(&mut text).ok()?;
    status.success().then_some(text)
}

/// Reads a line of `nvidia-smi`: numbers, or words in brackets for values the card does not provide.
fn nvidia_line(line: &str) -> Option<Reading> {
    let mut fields = line.lines().next()?.split(',').map(|field| field.trim().parse::<f64>().ok());
    let mut next = || fields.next();
    Some(Reading { clock_mhz: next()?, power_w: next()?, temperature_c: next()? })
}

/// Finds the sensors of the only card of the `amdgpu` driver; none where there are several, because nothing says which one is
/// meant.
fn the_only_amdgpu(drm: &Path) -> Option<PathBuf> {
    let entries = |directory: &Path| std::fs::read_dir(directory).into_iter().flatten().flatten().map(|e| e.path());
    let is_card = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        name.strip_prefix("card").is_some_and(|n| n.parse::<u32>().is_ok())
    };
    let sensors = entries(drm).filter(is_card).flat_map(|card| entries(&card.join("device/hwmon")).collect::<Vec<_>>());
    let is_amd = |d: &PathBuf| std::fs::read_to_string(d.join("name")).is_ok_and(|name| name.trim() == "amdgpu");
    let mut found = sensors.filter(is_amd);
    found.next().filter(|_| found.next().is_none())
}

/// Reads files of the kernel's hardware monitor, which are in hertz, microwatts and thousandths of a degree.
fn read_amdgpu(directory: &Path) -> Option<Reading> {
    let number = |file: &str| std::fs::read_to_string(directory.join(file)).ok()?.trim().parse::<f64>().ok();
    let power = number("power1_average").or_else(|| number("power1_input"));
    Some(Reading {
        clock_mhz: Some(number("freq1_input")? * 1e-6),
        power_w: power.map(|microwatts| microwatts * 1e-6),
        temperature_c: number("temp1_input").map(|thousandths| thousandths * 1e-3),
    })
}

/// Returns the highest clock of the processors that `/proc/cpuinfo` lists, because other processors may be idle.
fn cpu_clock(cpuinfo: &str) -> Option<Reading> {
    let field = |line: &str| line.strip_prefix("cpu MHz")?.split(':').nth(1)?.trim().parse::<f64>().ok();
    let clocks: Vec<f64> = cpuinfo.lines().filter_map(field).collect();
    let span = span(clocks.into_iter())?;
    Some(Reading { clock_mhz: Some(span.max), ..Reading::default() })
}

/// Returns the name of the host's processor from `/proc/cpuinfo`.
pub fn host_processor() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split(':').nth(1)?.trim().to_owned())
}

fn span(values: impl Iterator<Item = f64>) -> Option<Span> {
    let (mut count, mut sum, mut min, mut max) = (0, 0.0, f64::INFINITY, f64::NEG_INFINITY);
    for value in values {
        (count, sum) = (count + 1, sum + value);
        (min, max) = (value.min(min), value.max(max));
    }
    (count > 0).then(|| Span { min, mean: sum / f64::from(count), max })
}

fn summary(source: &Source, readings: &[Reading]) -> Readings {
    let of = |quantity: fn(&Reading) -> Option<f64>| span(readings.iter().filter_map(quantity));
    Readings {
        source: source.name().to_owned(),
        count: readings.len(),
        clock_mhz: of(|r| r.clock_mhz),
        power_w: of(|r| r.power_w),
        temperature_c: of(|r| r.temperature_c),
    }
}

/// Thread that reads a device's sensors until it is stopped.
pub struct Watch {
    stop: Sender<()>,
    thread: JoinHandle<Readings>,
}

impl Watch {
    /// Starts reading; none where no source can read the device's sensors.
    pub fn begin(info: &DeviceInfo) -> Option<Watch> {
        let source = Source::of(info)?;
        let (stop, stopped) = channel::<()>();
        let thread = std::thread::spawn(move || {
            let mut readings = Vec::new();
            loop {
                readings.extend(source.read());
                match stopped.recv_timeout(PAUSE) {
                    Err(RecvTimeoutError::Timeout) => {}
                    Ok(()) | Err(RecvTimeoutError::Disconnected) => return summary(&source, &readings),
                }
            }
        });
        Some(Watch { stop, thread })
    }

    /// Stops reading and returns the summary since the start.
    pub fn end(self) -> Option<Readings> {
        drop(self.stop);
        self.thread.join().ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_nvidia_smi_is_read() {
        // Output format of `nvidia-smi --query-gpu=clocks.sm,power.draw,temperature.gpu --format=csv,noheader,nounits`.
        let told = nvidia_line("1980, 412.35, 54\n").unwrap();
        assert_eq!(told, Reading { clock_mhz: Some(1980.0), power_w: Some(412.35), temperature_c: Some(54.0) });
        let silent = nvidia_line("1980, [N/A], [Not Supported]\n").unwrap();
        assert_eq!(silent, Reading { clock_mhz: Some(1980.0), power_w: None, temperature_c: None });
        assert_eq!(nvidia_line("No devices were found\n"), None);
        let uuid = nvidia_uuid("0123456789abcdef0123456789abcdef").unwrap();
        assert_eq!(uuid, "GPU-01234567-89ab-cdef-0123-456789abcdef");
        assert_eq!(nvidia_uuid("0123"), None);
    }

    #[cfg(unix)]
    #[test]
    fn a_program_that_hangs_is_given_up() {
        let shell = |script: &str| {
            let mut command = Command::new("sh");
            command.args(["-c", script]).stdout(Stdio::piped());
            command
        };
        assert_eq!(output_within(shell("echo 7"), PATIENCE).unwrap(), "7\n");
        assert_eq!(output_within(shell("echo 7; exit 3"), PATIENCE), None);
        assert_eq!(output_within(shell("exec sleep 60"), Duration::from_millis(20)), None);
    }

    #[test]
    fn sensors_of_the_only_amd_card_are_read() {
        let drm = tempfile::tempdir().unwrap();
        let card = |name: &str, driver: &str| {
            let sensors = drm.path().join(name).join("device/hwmon/hwmon3");
            std::fs::create_dir_all(&sensors).unwrap();
            for (file, text) in [("name", driver), ("freq1_input", "2400000000\n"), ("power1_average", "287000000\n")] {
                std::fs::write(sensors.join(file), text).unwrap();
            }
            sensors
        };
        let sensors = card("card1", "amdgpu\n");
        card("card0", "i915\n");
        // The directory lists a card's connectors beside the card.
        card("card1-DP-1", "amdgpu\n");
        assert_eq!(the_only_amdgpu(drm.path()), Some(sensors.clone()));
        let told = read_amdgpu(&sensors).unwrap();
        assert_eq!(told, Reading { clock_mhz: Some(2400.0), power_w: Some(287.0), temperature_c: None });
        card("card2", "amdgpu\n");
        assert_eq!(the_only_amdgpu(drm.path()), None);
    }

    #[test]
    fn spans_leave_out_what_was_not_told() {
        let at = |clock_mhz, power_w| Reading { clock_mhz, power_w, temperature_c: None };
        let readings = [at(Some(1000.0), None), at(Some(2000.0), Some(100.0)), at(None, Some(300.0))];
        let told = summary(&Source::CpuInfo, &readings);
        assert_eq!(told.clock_mhz, Some(Span { min: 1000.0, mean: 1500.0, max: 2000.0 }));
        assert_eq!(told.power_w.unwrap().mean, 200.0);
        assert_eq!((told.count, told.temperature_c), (3, None));
        let cpu = cpu_clock("processor\t: 0\ncpu MHz\t\t: 2400.5\nprocessor\t: 1\ncpu MHz\t\t: 2600.5\n").unwrap();
        assert_eq!(cpu.clock_mhz, Some(2600.5));
        assert_eq!(cpu_clock("processor\t: 0\n"), None);
    }
}
