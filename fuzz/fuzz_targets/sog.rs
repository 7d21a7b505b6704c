#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    hostile_files::run(hostile_files::format("sog"), bytes);
});
