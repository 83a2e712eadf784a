//! Every context of a process gets its own messages, whichever came first. This is one test, alone in its process, because
//! it concerns the process's cached log statements.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]
#![allow(clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

#[path = "common/c_scene.rs"]
mod c_scene;

use c_scene::ok;
use nertca_vk_abi::context::*;
use nertca_vk_abi::log::NERTCA_LOG_WARNING;
use nertca_vk_abi::types::*;
use std::ffi::{CStr, c_char, c_void};
use std::ptr::null_mut;
use std::sync::{Barrier, Mutex};

/// Messages of one context.
type Heard = Mutex<Vec<String>>;

unsafe extern "C" fn hear(_: u32, text: *const c_char, user: *mut c_void) {
    let heard = unsafe { &*user.cast::<Heard>() };
    heard.lock().unwrap().push(unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned());
}

/// Opens a context whose end is logged: its pipeline cache cannot be written to an impossible directory.
fn open(log: Option<&Heard>) -> *mut nertca_context {
    let log = log.map(|heard| nertca_log {
        size: size_of::<nertca_log>(),
        callback: Some(hear),
        user: std::ptr::from_ref(heard).cast_mut().cast(),
        level: NERTCA_LOG_WARNING,
    });
    let log = log.as_ref().map_or(std::ptr::null(), std::ptr::from_ref);
    let mut context = null_mut();
    let options = c"cache_dir = /dev/null/nowhere";
    ok(unsafe { nertca_context_create(options.as_ptr(), log, &mut context) }, std::ptr::null::<c_void>());
    context
}

#[track_caller]
fn close(context: *mut nertca_context) {
    ok(unsafe { nertca_context_destroy(context) }, context);
}

#[track_caller]
fn expect_one(heard: &Heard) {
    let heard = heard.lock().unwrap();
    assert!(heard.len() == 1 && heard[0].contains("/dev/null/nowhere"), "{heard:?}");
}

#[test]
fn a_context_without_a_log_silences_no_other() {
    // This is the only log, while a thread without one logs first.
    let first = Heard::default();
    let listening = open(Some(&first));
    std::thread::scope(|scope| scope.spawn(|| close(open(None))).join().unwrap());
    close(listening);
    expect_one(&first);

    // Threads with and without a log arrive in any order.
    for _ in 0..6 {
        let heard: [Heard; 2] = Default::default();
        let together = Barrier::new(4);
        std::thread::scope(|scope| {
            for log in [Some(&heard[0]), None, Some(&heard[1]), None] {
                let together = &together;
                scope.spawn(move || {
                    let context = open(log);
                    together.wait();
                    close(context);
                });
            }
        });
        heard.iter().for_each(expect_one);
    }
}
