//! Pipelines are kept while somebody wants that: a session that fits anew does not compile its kernels again.

use crate::common::{expect_silence, gpu};
use nertca_vk::kernels::stages::kernel_code;
use std::sync::Arc;

#[test]
fn a_pipeline_that_is_kept_is_not_built_again() {
    let gpu = gpu();
    let build = |local_size| gpu.pipeline(kernel_code("peak_copy").unwrap(), local_size, &[]).unwrap();
    assert!(!Arc::ptr_eq(&build(64), &build(64)), "nobody keeps them");
    let (one, other) = (gpu.keep_pipelines(), gpu.keep_pipelines());
    let first = build(64);
    assert!(Arc::ptr_eq(&first, &build(64)) && !Arc::ptr_eq(&first, &build(32)), "the same, and another");
    drop(one);
    assert!(Arc::ptr_eq(&first, &build(64)), "somebody keeps them still");
    drop(other);
    assert!(!Arc::ptr_eq(&first, &build(64)));
    drop(first);
    expect_silence(gpu);
}
