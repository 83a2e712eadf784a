#![no_main]
libfuzzer_sys::fuzz_target!(init: nertca_vk_fuzz::begin("rtk"), |bytes: &[u8]| nertca_vk_fuzz::feed(bytes));
