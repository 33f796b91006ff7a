// Point clouds as the benchmarks write them for the peers' drivers (peers.py, write_clouds), and the drivers' clock.
//
// The file is little-endian: int64 clouds; for each int64 points, 3 float32 origin, 3 float32 per point, uint8 class per
// point; all coordinates in the world's frame [m].

#pragma once

#include <time.h>

#include <cstdint>
#include <fstream>
#include <stdexcept>
#include <vector>

struct RawCloud {
  std::vector<float> origin;
  std::vector<float> points;
  std::vector<uint8_t> classes;
};

template <class T>
std::vector<T> readValues(std::ifstream& file, std::size_t count) {
  std::vector<T> values(count);
  file.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(count * sizeof(T)));
  if (!file) throw std::runtime_error("the file of clouds is cut");
  return values;
}

inline std::vector<RawCloud> readClouds(const char* path) {
  std::ifstream file(path, std::ios::binary);
  std::vector<RawCloud> clouds(readValues<int64_t>(file, 1)[0]);
  for (RawCloud& cloud : clouds) {
    const std::size_t count = readValues<int64_t>(file, 1)[0];
    cloud.origin = readValues<float>(file, 3);
    cloud.points = readValues<float>(file, 3 * count);
    cloud.classes = readValues<uint8_t>(file, count);
  }
  return clouds;
}

// Processor time of this thread [ns]: other programs on the core do not count.
inline long long processorTime() {
  timespec time;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return time.tv_sec * 1000000000LL + time.tv_nsec;
}
