//! Total and free memory of a device.

use super::device::Gpu;
use ash::vk;
use std::fmt;

/// Bytes of a MiB, the unit of memory in messages.
const MIB: u64 = 1 << 20;

/// Largest device-local heap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceMemory {
    /// Its size, bytes.
    pub bytes: u64,
    /// Bytes of it that this process can still allocate; none where the device does not report them (`VK_EXT_memory_budget`).
    pub free: Option<u64>,
}

impl fmt::Display for DeviceMemory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} MiB", self.bytes / MIB)?;
        match self.free {
            Some(free) => write!(f, ", of which {} MiB are currently free for this process", free / MIB),
            None => Ok(()),
        }
    }
}

impl DeviceMemory {
    /// Reads the current state. The budget is a query of the physical device: the device need not be made with the extension.
    pub(super) fn of(instance: &ash::Instance, physical: vk::PhysicalDevice, tells_budget: bool) -> DeviceMemory {
        let mut budget = vk::PhysicalDeviceMemoryBudgetPropertiesEXT::default();
        let mut memory = vk::PhysicalDeviceMemoryProperties2::default();
        if tells_budget {
            memory = memory.push_next(&mut budget);
        }
        // SAFETY: callers take `physical` from this instance, and say correctly whether it offers the extension whose structure
        // is chained; the chain lives until the call returns.
        unsafe { instance.get_physical_device_memory_properties2(physical, &mut memory) };
        let memory = memory.memory_properties;
        largest(&memory.memory_heaps[..memory.memory_heap_count as usize], tells_budget.then_some(&budget))
    }
}

fn largest(heaps: &[vk::MemoryHeap], budget: Option<&vk::PhysicalDeviceMemoryBudgetPropertiesEXT<'_>>) -> DeviceMemory {
    let own = heaps.iter().enumerate().filter(|(_, heap)| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
    let Some((index, heap)) = own.max_by_key(|(_, heap)| heap.size) else {
        return DeviceMemory { bytes: 0, free: None };
    };
    // A budget includes the memory that this process has already taken; other processes may leave it less. A driver whose
    // budget exceeds the heap's size counts memory of another kind.
    let left = |budget: &vk::PhysicalDeviceMemoryBudgetPropertiesEXT<'_>| {
        budget.heap_budget[index].saturating_sub(budget.heap_usage[index]).min(heap.size)
    };
    DeviceMemory { bytes: heap.size, free: budget.map(left) }
}

impl Gpu {
    /// Returns the current memory of the device; the free part changes with allocations of this process and others.
    pub fn memory(&self) -> DeviceMemory {
        self.shared.memory()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_is_what_the_budget_of_the_largest_own_heap_leaves() {
        let own = vk::MemoryHeapFlags::DEVICE_LOCAL;
        let heap = |size, flags| vk::MemoryHeap { size, flags };
        // The heaps are the host's memory, a window into the device's memory, and the device's memory.
        let heaps = [heap(900, vk::MemoryHeapFlags::empty()), heap(200, own), heap(800, own)];
        let told = |budget: [u64; 3], usage: [u64; 3]| {
            let mut told = vk::PhysicalDeviceMemoryBudgetPropertiesEXT::default();
            told.heap_budget[..3].copy_from_slice(&budget);
            told.heap_usage[..3].copy_from_slice(&usage);
            largest(&heaps, Some(&told))
        };
        let memory = |free| DeviceMemory { bytes: 800, free };
        assert_eq!(told([900, 150, 700], [1, 2, 100]), memory(Some(600)));
        assert_eq!(told([900, 150, 90], [0, 0, 100]), memory(Some(0)), "others have taken what was ours to take");
        assert_eq!(told([900, 150, 2000], [0; 3]), memory(Some(800)), "no more than there is");
        assert_eq!(largest(&heaps, None), memory(None));
        assert_eq!(largest(&heaps[..1], None), DeviceMemory { bytes: 0, free: None });
    }

    #[test]
    fn people_are_told_both_numbers() {
        let memory = |free| DeviceMemory { bytes: 8 << 30, free }.to_string();
        assert_eq!(memory(None), "8192 MiB");
        assert_eq!(memory(Some(100 << 20)), "8192 MiB, of which 100 MiB are currently free for this process");
    }
}
