//! Handles are indices with a generation into one table of the objects that are alive. A handle that was destroyed, has
//! another type or is arbitrary can therefore be recognised without touching memory. The table is the only process-wide
//! state of the ABI's objects.

use crate::status::{Failure, NERTCA_ERROR_FORKED, NERTCA_ERROR_HANDLE, Outcome};
use std::any::Any;
use std::cell::RefCell;
use std::sync::{Arc, PoisonError, RwLock};

/// Number of low bits of a handle, which hold 1 + its index.
const INDEX_BITS: u32 = 20;

/// Object behind a handle.
type Object = Arc<dyn Any + Send + Sync>;

struct Slot {
    generation: usize,
    object: Option<Object>,
}

struct Table {
    slots: Vec<Slot>,
    free: Vec<usize>,
}

static TABLE: RwLock<Table> = RwLock::new(Table { slots: Vec::new(), free: Vec::new() });

thread_local! {
    /// Handles of the calls this thread is inside of, the outermost first; callbacks can nest calls.
    static ACTIVE: RefCell<Vec<usize>> = const { RefCell::new(Vec::new()) };
}

/// Type of objects that have handles.
pub(super) trait Kind: Any + Send + Sync {
    const NAME: &'static str;
    /// Returns the id of the process that made the object.
    fn process(&self) -> u32;
}

fn parts(handle: usize) -> Option<(usize, usize)> {
    let index = handle & ((1 << INDEX_BITS) - 1);
    Some((index.checked_sub(1)?, handle >> INDEX_BITS))
}

/// Makes a handle for an object.
pub(super) fn insert<T: Kind>(object: Arc<T>) -> Outcome<usize> {
    let mut table = TABLE.write().unwrap_or_else(PoisonError::into_inner);
    let object: Option<Object> = Some(object);
    let index = match table.free.pop() {
        Some(index) => index,
        None if table.slots.len() + 1 < 1 << INDEX_BITS => {
            table.slots.push(Slot { generation: 1, object: None });
            table.slots.len() - 1
        }
        None => return Err(Failure::new(NERTCA_ERROR_HANDLE, "too many handles")),
    };
    let slot = &mut table.slots[index];
    slot.object = object;
    Ok(slot.generation << INDEX_BITS | (index + 1))
}

/// Tells whether a handle refers to an object that is alive.
pub(super) fn exists(handle: usize) -> bool {
    let table = TABLE.read().unwrap_or_else(PoisonError::into_inner);
    let slot = parts(handle).and_then(|(index, generation)| {
        table.slots.get(index).filter(|slot| slot.generation == generation && slot.object.is_some())
    });
    slot.is_some()
}

/// Object behind a handle, kept alive and marked as in use by this thread until dropped.
pub(super) struct InUse<T> {
    object: Arc<T>,
}

impl<T> std::ops::Deref for InUse<T> {
    type Target = Arc<T>;

    fn deref(&self) -> &Arc<T> {
        &self.object
    }
}

impl<T> Drop for InUse<T> {
    fn drop(&mut self) {
        let _ = ACTIVE.try_with(|active| active.borrow_mut().pop());
    }
}

/// Finds the object behind a handle.
pub(super) fn get<T: Kind, H>(handle: *const H) -> Outcome<InUse<T>> {
    let object = find::<T>(handle.addr())?;
    let _ = ACTIVE.try_with(|active| active.borrow_mut().push(handle.addr()));
    Ok(InUse { object })
}

fn find<T: Kind>(handle: usize) -> Outcome<Arc<T>> {
    let bad = |problem: &str| Failure::new(NERTCA_ERROR_HANDLE, format!("{}: {problem}", T::NAME));
    if handle == 0 {
        return Err(bad("is null"));
    }
    let object = {
        let table = TABLE.read().unwrap_or_else(PoisonError::into_inner);
        let slot = parts(handle)
            .and_then(|(index, generation)| table.slots.get(index).filter(|slot| slot.generation == generation));
        slot.and_then(|slot| slot.object.clone())
    };
    let object = object.ok_or_else(|| bad("was destroyed or never existed"))?;
    let object = object.downcast::<T>().map_err(|_| bad("is a handle of another type"))?;
    if object.process() != std::process::id() {
        return Err(Failure::new(NERTCA_ERROR_FORKED, format!("{}: was created before a fork", T::NAME)));
    }
    Ok(object)
}

/// Tells whether this thread is inside a call on a handle, as callbacks are.
pub(super) fn is_active<H>(handle: *const H) -> bool {
    ACTIVE.try_with(|active| active.borrow().contains(&handle.addr())).unwrap_or(false)
}

/// Makes a handle stale, and returns its object once no other call uses it.
pub(super) fn remove<T: Kind, H>(handle: *const H) -> Outcome<Arc<T>> {
    let object = find::<T>(handle.addr())?;
    {
        let mut table = TABLE.write().unwrap_or_else(PoisonError::into_inner);
        let Some((index, generation)) = parts(handle.addr()) else { return Ok(object) };
        let slot = &mut table.slots[index];
        if slot.generation != generation || slot.object.is_none() {
            // Another thread destroyed it first.
            return Err(Failure::new(NERTCA_ERROR_HANDLE, format!("{}: was destroyed or never existed", T::NAME)));
        }
        slot.object = None;
        slot.generation = (slot.generation + 1) & (usize::MAX >> INDEX_BITS);
        table.free.push(index);
    }
    while Arc::strong_count(&object) > 1 {
        std::thread::sleep(std::time::Duration::from_micros(200));
    }
    Ok(object)
}
